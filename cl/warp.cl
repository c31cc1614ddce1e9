/* A volume seen through a displacement, (W v)(y) = v(y + w(y)), trilinear and zero outside the volume, and its exact
   transpose. The displacement of a state is w = sum of shares[r] * fields[r], in voxels. Twin: operators/twins/warp.py.
     warp_forward       a work-item takes LANES voxels along x.
     warp_adjoint_rows  CPUs: a work-item owns some slices of the result, to which it adds every voxel that reaches them.
     warp_adjoint_fixed GPUs: a work-item adds its voxel to eight integers, whose sums do not depend on their order.
     warp_adjoint_sum   adds such integers to the result.
     add_frames         adds the frames of a state to some of a stack.
   Near voxels move together. So LANES voxels meet a few more samples than one voxel does, and each sample is a vector of the
   volume with a hat-shaped weight. Voxels that part more than MOST_SAMPLES allows are taken one by one. */
#include "common/lanes.h"

#define MOST_SAMPLES 48

#if LANES == 1
#define VI_LEAST(v) (v)
#define VI_MOST(v) (v)
#define V_AT(v, k) (v)
#else
#define VI_LEAST(v) vi_least(v)
#define VI_MOST(v) (-vi_least(-(v)))
static inline int vi_least(const vi v)
{
#if LANES == 4
    const int4 a = v;
#elif LANES == 8
    const int4 a = min(v.lo, v.hi);
#else
    const int8 b = min(v.lo, v.hi);
    const int4 a = min(b.lo, b.hi);
#endif
    const int2 c = min(a.lo, a.hi);
    return min(c.x, c.y);
}
#endif

/* Where LANES voxels look in the volume, and the samples around them: `count` of them along an axis from `first` on, which
   along x moves with the lane. */
typedef struct {
    vf at;
    int first, count;
} Samples;

static inline vf hat(const vf distance) { return fmax(1.0f - fabs(distance), (vf)(0.0f)); }

static inline vf displacement(
    __global const float *fields, __global const float *shares, const size_t voxels, const int axis, const size_t voxel)
{
    vf sum = 0.0f;
    for (int r = 0; r < RANK; ++r)
        sum += shares[r] * V_LOAD(fields + (3 * r + axis) * voxels + voxel);
    return sum;
}

/* Positions beyond the zeros around the volume are moved there. */
static inline Samples samples_of(const vf position, const vi lane, const int length)
{
    Samples s;
    s.at = clamp(position, -1.0f, (float)length);
    const vi below = min(V_INT(floor(s.at)), length - 1) - lane;
    s.first = VI_LEAST(below);
    s.count = VI_MOST(below) - s.first + 2;
    return s;
}

#define WARP_SAMPLES(y_, z_)                                                                                    \
    const vi lane = V_INT(V_IOTA);                                                                              \
    const size_t voxel = ((size_t)(z_) * shape.y + (y_)) * shape.x + first;                                     \
    const Samples sx = samples_of(V_IOTA + (float)first + displacement(fields, shares, voxels, 0, voxel), lane, shape.x); \
    const Samples sy = samples_of((float)(y_) + displacement(fields, shares, voxels, 1, voxel), 0, shape.y);    \
    const Samples sz = samples_of((float)(z_) + displacement(fields, shares, voxels, 2, voxel), 0, shape.z);

__kernel void warp_forward(
    __global const float *volume, /* rows with a pitch, in a border of zeros; `strides`: start, row, slice */
    const long4 strides,
    __global const float *fields, /* (RANK, 3: x y z, nz, ny, nx) voxels, and zeros for a vector's end */
    __global const float *shares, /* (RANK,) of the state */
    const int4 shape,
    __global float *result)       /* (nz, ny, nx) */
{
    const int first = (int)get_global_id(0) * LANES, y = get_global_id(1), z = get_global_id(2);
    if (first >= shape.x)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    WARP_SAMPLES(y, z)
    __global const float *origin = volume + strides.x;
    vf sum = 0.0f;
    if (sx.count * sy.count * sz.count <= MOST_SAMPLES) {
        for (int k = 0; k < sz.count; ++k) {
            const vf along_z = hat(sz.at - (float)(sz.first + k));
            for (int j = 0; j < sy.count; ++j) {
                const vf across = along_z * hat(sy.at - (float)(sy.first + j));
                __global const float *row = origin + (sz.first + k) * strides.z + (sy.first + j) * strides.y + sx.first;
                for (int i = 0; i < sx.count; ++i)
                    sum += across * hat(sx.at - (V_IOTA + (float)(sx.first + i))) * V_LOAD(row + i);
            }
        }
    }
#if LANES > 1
    else {
        float xs[LANES], ys[LANES], zs[LANES], sums[LANES];
        V_STORE(sx.at, xs);
        V_STORE(sy.at, ys);
        V_STORE(sz.at, zs);
        for (int l = 0; l < LANES; ++l) {
            const int ix = min((int)floor(xs[l]), shape.x - 1), iy = min((int)floor(ys[l]), shape.y - 1);
            const int iz = min((int)floor(zs[l]), shape.z - 1);
            const float fx = xs[l] - ix, fy = ys[l] - iy, fz = zs[l] - iz;
            __global const float *a = origin + iz * strides.z + iy * strides.y + ix, *b = a + strides.z;
            const float low = (1 - fy) * ((1 - fx) * a[0] + fx * a[1]) + fy * ((1 - fx) * a[strides.y] + fx * a[strides.y + 1]);
            const float high = (1 - fy) * ((1 - fx) * b[0] + fx * b[1]) + fy * ((1 - fx) * b[strides.y] + fx * b[strides.y + 1]);
            sums[l] = (1 - fz) * low + fz * high;
        }
        sum = V_LOAD(sums);
    }
    if (first + LANES > shape.x) { /* the row's end: the next row is another work-item's */
        float values[LANES];
        V_STORE(sum, values);
        for (int l = 0; first + l < shape.x; ++l)
            result[voxel + l] = values[l];
        return;
    }
#endif
    V_STORE(sum, result + voxel);
}

__kernel void warp_adjoint_rows(
    __global const float *values,  /* (nz, ny, nx), and zeros for a vector's end */
    __global const float *fields, __global const float *shares, const int4 shape,
    __global const float2 *slices, /* (nz,) least and largest displacement along z in a slice */
    __global const float2 *rows,   /* (nz, ny) in a row */
    const int owned,               /* slices of a work-item */
    const long4 strides,
    __global float *result)        /* as the volume of warp_forward: the sums begin with what is in it */
{
    const int z_start = (int)get_global_id(0) * owned, z_stop = min(z_start + owned, shape.z);
    if (z_start >= shape.z)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    __global float *origin = result + strides.x;
    for (int z = 0; z < shape.z; ++z) {
        if (z + slices[z].y <= (float)(z_start - 1) || z + slices[z].x >= (float)z_stop)
            continue;
        for (int y = 0; y < shape.y; ++y) {
            const float2 reach = (float)z + rows[(size_t)z * shape.y + y];
            if (reach.y <= (float)(z_start - 1) || reach.x >= (float)z_stop)
                continue;
            for (int first = 0; first < shape.x; first += LANES) {
                WARP_SAMPLES(y, z)
                const vf value = V_PICK(0.0f, V_LOAD(values + voxel), V_IOTA < (float)(shape.x - first));
                if (sx.count * sy.count * sz.count <= MOST_SAMPLES) {
                    for (int i = 0; i < sx.count; ++i) {
                        const vf along_x = value * hat(sx.at - (V_IOTA + (float)(sx.first + i)));
                        for (int k = max(sz.first, z_start); k < min(sz.first + sz.count, z_stop); ++k) {
                            const vf plane = along_x * hat(sz.at - (float)k);
                            for (int j = max(sy.first, 0); j < min(sy.first + sy.count, shape.y); ++j) {
                                __global float *at = origin + k * strides.z + j * strides.y + sx.first + i;
                                V_STORE(V_LOAD(at) + plane * hat(sy.at - (float)j), at);
                            }
                        }
                    }
                    continue;
                }
#if LANES > 1
                float xs[LANES], ys[LANES], zs[LANES], each[LANES];
                V_STORE(sx.at, xs);
                V_STORE(sy.at, ys);
                V_STORE(sz.at, zs);
                V_STORE(value, each);
                for (int l = 0; l < min(LANES, shape.x - first); ++l) {
                    const int ix = min((int)floor(xs[l]), shape.x - 1), iy = min((int)floor(ys[l]), shape.y - 1);
                    const int iz = min((int)floor(zs[l]), shape.z - 1);
                    for (int k = max(iz, z_start); k < min(iz + 2, z_stop); ++k)
                        for (int j = max(iy, 0); j < min(iy + 2, shape.y); ++j) {
                            __global float *at = origin + k * strides.z + j * strides.y + ix;
                            const float part = each[l] * (1 - fabs(zs[l] - k)) * (1 - fabs(ys[l] - j));
                            at[0] += part * (1 - (xs[l] - ix));
                            at[1] += part * (xs[l] - ix);
                        }
                }
#endif
            }
        }
    }
}

#if LANES == 1
__kernel void warp_adjoint_fixed(
    __global const float *values, __global const float *fields, __global const float *shares, const int4 shape,
    const float scale,     /* integers per unit: no sum overflows */
    __global int *result)  /* (nz, ny, nx) zeros */
{
    const int first = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (first >= shape.x)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    WARP_SAMPLES(y, z)
    const float value = scale * values[voxel];
    for (int k = max(sz.first, 0); k < min(sz.first + 2, shape.z); ++k)
        for (int j = max(sy.first, 0); j < min(sy.first + 2, shape.y); ++j)
            for (int i = max(sx.first, 0); i < min(sx.first + 2, shape.x); ++i) {
                const float part = value * hat(sz.at - (float)k) * hat(sy.at - (float)j) * hat(sx.at - (float)i);
                atomic_add(result + ((size_t)k * shape.y + j) * shape.x + i, convert_int_rte(part));
            }
}

__kernel void warp_adjoint_sum(
    __global const int *sums, const float unit, const int4 shape, const long4 strides, __global float *result)
{
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (x < shape.x)
        result[strides.x + z * strides.z + y * strides.y + x] +=
            unit * convert_float(sums[((size_t)z * shape.y + y) * shape.x + x]);
}
#endif

__kernel void add_frames(
    __global const float *frames, /* (n, pixels) */
    __global const int *places,   /* (n,) of them in the stack */
    const int pixels, __global float *stack)
{
    const int pixel = get_global_id(0), frame = get_global_id(1);
    if (pixel < pixels)
        stack[(size_t)places[frame] * pixels + pixel] += frames[(size_t)frame * pixels + pixel];
}
