/* Warps a volume by a displacement, (W v)(y) = v(y + w(y)), and its exact transpose. In a state of an object that moves, the
   displacement is w = sum of shares[r] * fields[r], in voxels. Twin: operators/twins/rays.py.
   v interpolates the voxels by cubic splines, and is zero outside the volume. The splines' coefficients are stored like the
   volume, with BORDER more around. M. Unser, A. Aldroubi and M. Eden, B-spline signal processing, IEEE Trans. Signal
   Processing 41, 821-833 (1993).
     spline_along_x     voxels to coefficients in place, along x (a symmetric map); a work-item takes a row.
     spline_across_x    the same along y or z; a work-item takes LANES neighbouring lines of voxels.
     warp_forward       a work-item takes LANES voxels along x.
     warp_adjoint_rows  CPUs: a work-item sums some slices of the result, over every voxel that reaches them.
     warp_adjoint_fixed GPUs: a group adds its voxels to integers, whose sums do not depend on the order.
     warp_adjoint_sum   adds these integers to the result.
     add_frames         adds the frames of a state to some frames of a stack.
   Neighbouring voxels move nearly equally. So LANES voxels need only a few more coefficients along an axis than one voxel,
   and are computed together. If they need more than MOST_TAPS, they are computed one by one. */
#include "common/lanes.h"

#define REACH 2 /* a coefficient acts on points less than this away, in voxels */
#define BORDER 4
#define TAPS (2 * REACH)
#define MOST_TAPS (TAPS + 2)
#define SLAB 2048 /* coefficients in a group's local memory: 15 x 15 x 9 are needed if 8 x 8 x 4 voxels spread by a third */

#define POLE -0.26794919f /* sqrt(3) - 2, the pole of the cubic spline filter */

/* Solves c[k - 1] + 4 c[k] + c[k + 1] = 6 v[k] along a line, where v is zero beyond the ends. */
#define SPLINE_COEFFICIENTS(type, load, store)            \
    type sum = 0.0f;                                      \
    for (int k = 0; k < length; ++k) {                    \
        sum = 6.0f * load(line + k * step) + POLE * sum;  \
        store(sum, line + k * step);                      \
    }                                                     \
    sum *= -POLE / (1.0f - POLE * POLE);                  \
    store(sum, line + (length - 1) * step);               \
    for (int k = length - 2; k >= 0; --k) {               \
        sum = POLE * (sum - load(line + k * step));       \
        store(sum, line + k * step);                      \
    }
#define LOAD_ONE(at) (*(at))
#define STORE_ONE(value, at) (*(at) = (value))

__kernel void spline_along_x(
    __global float *volume, const long start, /* the first element of the first row */
    const long row,                           /* floats from one row to the next */
    const int rows, const int length)
{
    if ((int)get_global_id(0) >= rows)
        return;
    __global float *line = volume + start + get_global_id(0) * row;
    const long step = 1;
    SPLINE_COEFFICIENTS(float, LOAD_ONE, STORE_ONE)
}

__kernel void spline_across_x(
    __global float *volume, const long start,
    const long width, const long plane, /* number of neighbouring lines; floats from one plane of them to the next */
    const long step, const int length)  /* floats from one element of a line to the next */
{
    if ((long)get_global_id(0) * LANES >= width)
        return;
    __global float *line = volume + start + get_global_id(0) * LANES + get_global_id(1) * plane;
    SPLINE_COEFFICIENTS(vf, V_LOAD, V_STORE)
}

/* The cubic B-spline: the weight of a coefficient at a distance in voxels. It is 0 from REACH on. */
static inline float one_tap(const float distance)
{
    const float x = fmin(fabs(distance), 2.0f), far = 2.0f - x;
    return x < 1.0f ? (0.5f * x - 1.0f) * x * x + 2.0f / 3 : far * far * far * (1.0f / 6);
}

static inline int first_tap(const float at)
{
    return (int)floor(at) + 1 - REACH;
}

/* The coefficients along one axis that LANES voxels need, with their weights: `count` coefficients from `first` on. Along x,
   `first` is one more in each lane. at: the displaced positions. is_far: whether a lane needs other coefficients.
   is_outside: whether its position is more than REACH outside the volume, where the value is 0. */
typedef struct {
    vf at;
    vi is_far, is_outside;
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

/* Displacements mostly rise or fall along the lanes, so the first and the last lane give the range of all. Lanes for which
   this is wrong become is_far. */
static inline Samples samples_of(const vf position, const vi lane, const int length)
{
    Samples s;
    s.at = clamp(position, (float)-REACH, (float)(length - 1 + REACH));
    s.is_outside = position != s.at;
    const vf before = floor(s.at);
    const vi first = V_INT(before) + 1 - REACH - lane;
    s.first = min(V_FIRST(first), V_LAST(first));
    const int spread = max(V_FIRST(first), V_LAST(first)) - s.first;
    s.count = TAPS + spread;
    const vi late = first - s.first;
    s.is_far = (late < 0) | (late > min(spread, MOST_TAPS - TAPS));
    const vf t = s.at - before, u = 1.0f - t;
    const vf w[MOST_TAPS + 2] = {
        0.0f, 0.0f, u * u * u * (1.0f / 6), (0.5f * t - 1.0f) * t * t + 2.0f / 3, (0.5f * u - 1.0f) * u * u + 2.0f / 3,
        t * t * t * (1.0f / 6), 0.0f, 0.0f,
    };
    for (int i = 0; i < MOST_TAPS; ++i)
        s.weights[i] = V_PICK(V_PICK(w[i], w[i + 1], late < 2), w[i + 2], late < 1);
    return s;
}

#define IS_TOGETHER (!V_ANY(sx.is_far | sy.is_far | sz.is_far))

#define ZERO_OUTSIDE(value) V_PICK((value), 0.0f, sx.is_outside | sy.is_outside | sz.is_outside)

#define WARP_SAMPLES(y_, z_)                                                                                    \
    const vi lane = V_INT(V_IOTA);                                                                              \
    const size_t voxel = ((size_t)(z_) * shape.y + (y_)) * shape.x + first;                                     \
    const Samples sx = samples_of(V_IOTA + (float)first + displacement(fields, shares, voxels, 0, voxel), lane, shape.x); \
    const Samples sy = samples_of((float)(y_) + displacement(fields, shares, voxels, 1, voxel), 0, shape.y);    \
    const Samples sz = samples_of((float)(z_) + displacement(fields, shares, voxels, 2, voxel), 0, shape.z);

__kernel void warp_forward(
    __global const float *volume, /* coefficients, padded; strides: start, row, slice */
    const long4 strides,
    __global const float *fields, /* (RANK, 3: x y z, nz, ny, nx) in voxels; zeros follow, which vectors may read */
    __global const float *shares, /* (RANK,): the weight of each field in the state */
    const int4 shape,
    __global float *result)       /* (nz, ny, nx): the warped volume */
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
                for (int i = 1; i < TAPS; ++i)
                    along_x += sx.weights[i] * V_LOAD(row + i);
                if (sx.count > TAPS)
                    for (int i = TAPS; i < MOST_TAPS; ++i)
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
            const int ix = first_tap(xs[l]), iy = first_tap(ys[l]), iz = first_tap(zs[l]);
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
#endif
    sum = ZERO_OUTSIDE(sum);
#if LANES > 1
    if (first + LANES > shape.x) { /* another work-item writes the next row */
        for (int l = 0; first + l < shape.x; ++l)
            result[voxel + l] = ((float *)&sum)[l];
        return;
    }
#endif
    V_STORE(sum, result + voxel);
}

/* Whether voxels of slice z, with displacements along z in `range`, add to the slices of this work-item. */
#define REACHES(range) (z + (range).y > (float)(z_start - REACH) && z + (range).x < (float)(z_stop - 1 + REACH))

__kernel void warp_adjoint_rows(
    __global const float *values,  /* (nz, ny, nx); zeros follow, which vectors may read */
    __global const float *fields, __global const float *shares, const int4 shape,
    __global const float2 *slices, /* (nz,): smallest and largest displacement along z in a slice */
    __global const float2 *rows,   /* (nz, ny): smallest and largest displacement along z in a row */
    const int owned,               /* slices of a work-item */
    const long4 strides,
    __global float *result)        /* laid out like the coefficients of warp_forward; the kernel adds to it */
{
    const int z_start = (int)get_global_id(0) * owned - BORDER, z_stop = min(z_start + owned, shape.z + BORDER);
    if (z_start >= z_stop)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    __global float *origin = result + strides.x;
    for (int z = 0; z < shape.z; ++z) {
        if (!REACHES(slices[z]))
            continue;
        for (int y = 0; y < shape.y; ++y) {
            if (!REACHES(rows[(size_t)z * shape.y + y]))
                continue;
            for (int first = 0; first < shape.x; first += LANES) {
                WARP_SAMPLES(y, z)
                const vf value = ZERO_OUTSIDE(V_PICK(0.0f, V_LOAD(values + voxel), V_IOTA < (float)(shape.x - first)));
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
                    const int ix = first_tap(xs[l]), iy = first_tap(ys[l]), iz = first_tap(zs[l]);
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
/* Neighbouring voxels add to the same coefficients. So a group sums in a slab of local memory, and then adds the slab to the
   result: a few global atomics per voxel instead of 64. A group whose voxels move too far apart adds to the result at once. */
__kernel void warp_adjoint_fixed(
    __global const float *values, __global const float *fields, __global const float *shares, const int4 shape,
    const float scale,     /* the integer that stands for 1: no sum overflows if a coefficient's weights sum to at most 64 */
    const long4 strides,
    __global int *result)  /* laid out like the coefficients; must be 0 before the launch */
{
    __local int slab[SLAB], low[3], high[3]; /* smallest and largest first coefficient of the group along x, y, z */
    const int3 at = (int3)((int)get_global_id(0), (int)get_global_id(1), (int)get_global_id(2));
    const int item = (int)((get_local_id(2) * get_local_size(1) + get_local_id(1)) * get_local_size(0) + get_local_id(0));
    const int items = (int)(get_local_size(0) * get_local_size(1) * get_local_size(2));
    const int3 held = min(at, shape.xyz - 1);
    const int first = held.x;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z;
    WARP_SAMPLES(held.y, held.z)
    const float value = ZERO_OUTSIDE(all(at == held) ? scale * values[voxel] : 0.0f);

    for (int k = item; k < SLAB; k += items)
        slab[k] = 0;
    if (item < 3) {
        low[item] = shape.x + shape.y + shape.z;
        high[item] = -low[item];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (value != 0.0f) {
        atomic_min(low, sx.first), atomic_max(high, sx.first);
        atomic_min(low + 1, sy.first), atomic_max(high + 1, sy.first);
        atomic_min(low + 2, sz.first), atomic_max(high + 2, sz.first);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const int3 corner = (int3)(low[0], low[1], low[2]);
    const int3 sides = max((int3)(high[0], high[1], high[2]) - corner + TAPS, 0);
    const bool is_near = max(max(sides.x, sides.y), sides.z) <= SLAB && (long)sides.x * sides.y * sides.z <= SLAB;

    if (value != 0.0f)
        for (int k = 0; k < TAPS; ++k)
            for (int j = 0; j < TAPS; ++j) {
                const float along = value * (sz.weights[k] * sy.weights[j]);
                const int3 to = (int3)(sx.first, sy.first + j, sz.first + k);
                __local int *near = slab + ((to.z - corner.z) * sides.y + to.y - corner.y) * sides.x + to.x - corner.x;
                __global int *far = result + strides.x + to.z * strides.z + to.y * strides.y + to.x;
                for (int i = 0; i < TAPS; ++i) {
                    const int part = convert_int_rte(along * sx.weights[i]);
                    if (is_near)
                        atomic_add(near + i, part);
                    else
                        atomic_add(far + i, part);
                }
            }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int k = item; is_near && k < sides.x * sides.y * sides.z; k += items)
        if (slab[k] != 0) {
            const int3 to = corner + (int3)(k % sides.x, k / sides.x % sides.y, k / sides.x / sides.y);
            atomic_add(result + strides.x + to.z * strides.z + to.y * strides.y + to.x, slab[k]);
        }
}

__kernel void warp_adjoint_sum(
    __global const int *sums, const float unit, const long count, __global float *result)
{
    const long k = get_global_id(0);
    if (k < count)
        result[k] += unit * convert_float(sums[k]);
}
#endif

__kernel void add_frames(
    __global const float *frames, /* (n, pixels): to be added to the stack */
    __global const int *places,   /* (n,): numbers of the frames in the stack */
    const int pixels, __global float *stack)
{
    const int pixel = get_global_id(0), frame = get_global_id(1);
    if (pixel < pixels)
        stack[(size_t)places[frame] * pixels + pixel] += frames[(size_t)frame * pixels + pixel];
}
