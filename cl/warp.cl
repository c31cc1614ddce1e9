/* A volume seen through a displacement, (W v)(y) = v(y + w(y)), interpolated and zero outside the volume, and its exact
   transpose. The displacement of a state is w = sum of shares[r] * fields[r], in voxels. Twin: operators/twins/warp.py.
   It interpolates by cubic convolution along each axis: R. G. Keys, IEEE Trans. Acoustics, Speech, Signal Processing 29,
   1153-1160 (1981), a = -1/2.
     warp_forward       a work-item takes LANES voxels along x.
     warp_adjoint_rows  CPUs: a work-item owns some slices of the result, to which it adds every voxel that reaches them.
     warp_adjoint_fixed GPUs: a work-item adds its voxel to integers, whose sums do not depend on their order.
     warp_adjoint_sum   adds such integers to the result.
     add_frames         adds the frames of a state to some of a stack.
   Near voxels move together. So LANES voxels meet a few more samples than one voxel does, and each sample is a vector of the
   volume with its weights. Voxels that part more than MOST_TAPS along an axis allows are taken one by one. */
#include "common/lanes.h"

#define REACH 2 /* voxels: as far as a sample counts */
#define TAPS (2 * REACH)
#define MOST_TAPS (TAPS + 2)

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

/* The weight of a sample at a distance of its voxels; 0 from REACH on. */
static inline vf tap(const vf distance)
{
    const vf x = fmin(fabs(distance), (vf)(2.0f));
    const vf near = (1.5f * x - 2.5f) * x * x + 1.0f, far = ((2.5f - 0.5f * x) * x - 4.0f) * x + 2.0f;
    return V_PICK(far, near, x < 1.0f);
}

static inline float one_tap(const float distance)
{
    const float x = fmin(fabs(distance), 2.0f);
    return x < 1.0f ? (1.5f * x - 2.5f) * x * x + 1.0f : ((2.5f - 0.5f * x) * x - 4.0f) * x + 2.0f;
}

static inline int first_tap(const float at, const int length)
{
    return clamp((int)floor(at) + 1 - REACH, -REACH, length - 1);
}

/* Where LANES voxels look in the volume, and the samples around them: `count` of them along an axis from `first` on, which
   along x moves with the lane, with the weights of the first MOST_TAPS. */
typedef struct {
    vf at;
    int first, count;
    vf weights[MOST_TAPS];
} Samples;

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
    s.at = clamp(position, (float)-REACH, (float)(length - 1 + REACH));
    const vi first = clamp(V_INT(floor(s.at)) + 1 - REACH, -REACH, length - 1) - lane;
    s.first = VI_LEAST(first);
    s.count = VI_MOST(first) - s.first + TAPS;
    for (int i = 0; i < MOST_TAPS; ++i)
        s.weights[i] = tap(s.at - V_FLOAT(lane + s.first + i));
    return s;
}

#define IS_TOGETHER (max(sx.count, max(sy.count, sz.count)) <= MOST_TAPS)

#define WARP_SAMPLES(y_, z_)                                                                                    \
    const vi lane = V_INT(V_IOTA);                                                                              \
    const size_t voxel = ((size_t)(z_) * shape.y + (y_)) * shape.x + first;                                     \
    const Samples sx = samples_of(V_IOTA + (float)first + displacement(fields, shares, voxels, 0, voxel), lane, shape.x); \
    const Samples sy = samples_of((float)(y_) + displacement(fields, shares, voxels, 1, voxel), 0, shape.y);    \
    const Samples sz = samples_of((float)(z_) + displacement(fields, shares, voxels, 2, voxel), 0, shape.z);

__kernel void warp_forward(
    __global const float *volume, /* rows with a pitch, in a border of 2 REACH zeros; `strides`: start, row, slice */
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
    if (IS_TOGETHER) {
        for (int k = 0; k < sz.count; ++k)
            for (int j = 0; j < sy.count; ++j) {
                __global const float *row = origin + (sz.first + k) * strides.z + (sy.first + j) * strides.y + sx.first;
                vf along_x = sx.weights[0] * V_LOAD(row);
                for (int i = 1; i < sx.count; ++i)
                    along_x += sx.weights[i] * V_LOAD(row + i);
                sum += sz.weights[k] * sy.weights[j] * along_x;
            }
    }
#if LANES > 1
    else {
        float xs[LANES], ys[LANES], zs[LANES], sums[LANES];
        V_STORE(sx.at, xs);
        V_STORE(sy.at, ys);
        V_STORE(sz.at, zs);
        for (int l = 0; l < LANES; ++l) {
            const int ix = first_tap(xs[l], shape.x), iy = first_tap(ys[l], shape.y), iz = first_tap(zs[l], shape.z);
            sums[l] = 0.0f;
            for (int k = iz; k < iz + TAPS; ++k)
                for (int j = iy; j < iy + TAPS; ++j) {
                    __global const float *row = origin + k * strides.z + j * strides.y;
                    const float across = one_tap(zs[l] - k) * one_tap(ys[l] - j);
                    for (int i = ix; i < ix + TAPS; ++i)
                        sums[l] += across * one_tap(xs[l] - i) * row[i];
                }
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
    __global float *result)        /* as the volume of warp_forward: sums begin with what is in it; its border is unused */
{
    const int z_start = (int)get_global_id(0) * owned, z_stop = min(z_start + owned, shape.z);
    if (z_start >= shape.z)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    __global float *origin = result + strides.x;
    for (int z = 0; z < shape.z; ++z) {
        if (z + slices[z].y <= (float)(z_start - REACH) || z + slices[z].x >= (float)(z_stop - 1 + REACH))
            continue;
        for (int y = 0; y < shape.y; ++y) {
            const float2 reach = (float)z + rows[(size_t)z * shape.y + y];
            if (reach.y <= (float)(z_start - REACH) || reach.x >= (float)(z_stop - 1 + REACH))
                continue;
            for (int first = 0; first < shape.x; first += LANES) {
                WARP_SAMPLES(y, z)
                const vf value = V_PICK(0.0f, V_LOAD(values + voxel), V_IOTA < (float)(shape.x - first));
                if (IS_TOGETHER) {
                    for (int i = 0; i < sx.count; ++i) {
                        const vf along_x = value * sx.weights[i];
                        for (int k = max(sz.first, z_start); k < min(sz.first + sz.count, z_stop); ++k) {
                            const vf plane = along_x * sz.weights[k - sz.first];
                            __global float *at = origin + k * strides.z + sy.first * strides.y + sx.first + i;
                            for (int j = 0; j < sy.count; ++j, at += strides.y)
                                V_STORE(V_LOAD(at) + plane * sy.weights[j], at);
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
                    const int ix = first_tap(xs[l], shape.x), iy = first_tap(ys[l], shape.y), iz = first_tap(zs[l], shape.z);
                    for (int k = max(iz, z_start); k < min(iz + TAPS, z_stop); ++k)
                        for (int j = iy; j < iy + TAPS; ++j) {
                            __global float *row = origin + k * strides.z + j * strides.y;
                            const float part = each[l] * one_tap(zs[l] - k) * one_tap(ys[l] - j);
                            for (int i = ix; i < ix + TAPS; ++i)
                                row[i] += part * one_tap(xs[l] - i);
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
    for (int k = max(sz.first, 0); k < min(sz.first + TAPS, shape.z); ++k)
        for (int j = max(sy.first, 0); j < min(sy.first + TAPS, shape.y); ++j)
            for (int i = max(sx.first, 0); i < min(sx.first + TAPS, shape.x); ++i) {
                const float across = sz.weights[k - sz.first] * sy.weights[j - sy.first];
                const float part = value * across * sx.weights[i - sx.first];
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
