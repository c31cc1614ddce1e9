/* Element-wise operations and sums of float arrays. Sums are in float64, or in pairs of floats if the device lacks it.
   They repeat bit for bit on a device, because work-items and then work-groups add in a fixed order.
   Twin: HostSpace of runtime/algebra.py. */
#include "common/precise.h"
#pragma OPENCL FP_CONTRACT OFF

#define LANE_OF(v, lane) (((float *)&(v))[lane])

static inline vf load_some(__global const float *p, const long count)
{
    if (count >= LANES)
        return V_LOAD(p);
    vf v = (vf)(0.0f);
    for (int k = 0; k < count; ++k)
        LANE_OF(v, k) = p[k];
    return v;
}

static inline void store_some(vf v, __global float *p, const long count)
{
    if (count >= LANES)
        V_STORE(v, p);
    else
        for (int k = 0; k < count; ++k)
            p[k] = LANE_OF(v, k);
}

/* result = max(x + scale y, least) */
__kernel void add_scaled(
    __global const float *x, const float scale, __global const float *y, const float least, const long count,
    __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at;
    if (rest > 0)
        store_some(fmax(load_some(x + at, rest) + scale * load_some(y + at, rest), (vf)(least)), result + at, rest);
}

/* result = x + scale (x - y) */
__kernel void extrapolate(
    __global const float *x, const float scale, __global const float *y, const long count, __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at;
    const vf here = load_some(x + at, rest);
    if (rest > 0)
        store_some(here + scale * (here - load_some(y + at, rest)), result + at, rest);
}

/* result = max(x + scale y z, least) */
__kernel void add_product(
    __global const float *x, const float scale, __global const float *y, __global const float *z, const float least,
    const long count, __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at;
    const vf product = scale * load_some(y + at, rest) * load_some(z + at, rest);
    if (rest > 0)
        store_some(fmax(load_some(x + at, rest) + product, (vf)(least)), result + at, rest);
}

/* result = x y. y has `count` elements and repeats along x; global index 1 counts the repeats. */
__kernel void multiply(
    __global const float *x, __global const float *y, const long count, __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at, there = get_global_id(1) * count + at;
    if (rest > 0)
        store_some(load_some(x + there, rest) * load_some(y + at, rest), result + there, rest);
}

/* result = 1 / max(x, least) where x > 0, else 0 */
__kernel void reciprocal(__global const float *x, const float least, const long count, __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at;
    const vf value = load_some(x + at, rest);
    if (rest > 0)
        store_some(V_PICK(0.0f, 1.0f / fmax(value, (vf)(least)), value > 0.0f), result + at, rest);
}

#if FP64
typedef double sum_t;
#define SUM_OF(value) ((double)(value))
static inline sum_t sum_add(const sum_t a, const sum_t b) { return a + b; }
static inline sum_t sum_of_lanes(vwide a)
{
    sum_t sum = 0.0;
    for (int k = 0; k < LANES; ++k)
        sum += ((double *)&a)[k];
    return sum;
}
static inline vwide plus_product(const vwide a, const vf x, const vf y) { return a + V_WIDE(x) * V_WIDE(y); }
static inline vwide wide_zero(void) { return (vwide)(0.0); }
static inline float share_of(const float2 step, const sum_t squares)
{
    return squares > 0.0 ? (float)(((double)step.x + step.y) / sqrt(squares)) : 0.0f;
}
#else
typedef float2 sum_t; /* high, low */
#define SUM_OF(value) ((float2)((value), 0.0f))
static inline sum_t sum_add(const sum_t a, const sum_t b)
{
    const float s = a.x + b.x, t = s - a.x;
    const float low = ((a.x - (s - t)) + (b.x - t)) + (a.y + b.y), high = s + low;
    return (float2)(high, low - (high - s));
}
static inline sum_t sum_of_lanes(vwide a)
{
    sum_t sum = (float2)(0.0f, 0.0f);
    for (int k = 0; k < LANES; ++k)
        sum = sum_add(sum, (float2)(LANE_OF(a.high, k), LANE_OF(a.low, k)));
    return sum;
}
static inline vwide plus_product(vwide a, const vf x, const vf y)
{
    const vf product = x * y;
    a = wide_sum(a, product);
    a.low += fma(x, y, -product);
    return a;
}
static inline vwide wide_zero(void)
{
    vwide a;
    a.high = a.low = (vf)(0.0f);
    return a;
}
static inline float share_of(const float2 step, const sum_t squares)
{
    return squares.x > 0.0f ? step.x / sqrt(squares.x + squares.y) : 0.0f;
}
#endif

/* Combines the results `own` of a work-group's items in pairs, in a fixed order. Item 0 gets the result and writes it to
   `target`. The group's size must be a power of 2. */
#define TREE(scratch, own, combined, target)                                                       \
    if (get_local_size(0) > 1) {                                                           \
        const int item = (int)get_local_id(0);                                             \
        scratch[item] = own;                                                               \
        for (int reach = (int)get_local_size(0) / 2; reach > 0; reach /= 2) {                 \
            barrier(CLK_LOCAL_MEM_FENCE);                                                  \
            if (item < reach)                                                              \
                scratch[item] = combined(scratch[item], scratch[item + reach]);            \
        }                                                                                  \
        if (item == 0)                                                                     \
            own = scratch[0];                                                              \
    }                                                                                      \
    if (get_local_id(0) == 0)                                                              \
        target = own;

/* parts = Σ x y, one sum per work-group. Work-item k adds the vectors of LANES elements that begin at k first_by,
   k first_by + step, ..., below k first_by + span. */
__kernel void dot_parts(
    __global const float *x, __global const float *y, const long count, const long first_by, const long step, const long span,
    __local sum_t *scratch, __global sum_t *parts)
{
    const long first = first_by * get_global_id(0), stop = min(first + span, count);
    vwide sum = wide_zero();
    for (long at = first; at < stop; at += step)
        sum = plus_product(sum, load_some(x + at, count - at), load_some(y + at, count - at));
    sum_t own = sum_of_lanes(sum);
    TREE(scratch, own, sum_add, parts[get_group_id(0)])
}

/* parts = Σ (x - y) (y - z), one sum per work-group, over the same elements as dot_parts. */
__kernel void turn_parts(
    __global const float *x, __global const float *y, __global const float *z, const long count, const long first_by,
    const long step, const long span, __local sum_t *scratch, __global sum_t *parts)
{
    const long first = first_by * get_global_id(0), stop = min(first + span, count);
    vwide sum = wide_zero();
    for (long at = first; at < stop; at += step) {
        const vf middle = load_some(y + at, count - at);
        sum = plus_product(sum, load_some(x + at, count - at) - middle, middle - load_some(z + at, count - at));
    }
    sum_t own = sum_of_lanes(sum);
    TREE(scratch, own, sum_add, parts[get_group_id(0)])
}

/* One work-group adds all `parts` and writes their sum to `whole`, or adds it there if `add`. */
__kernel void dot_whole(
    __global const sum_t *parts, const int count, const int add, __local sum_t *scratch, __global sum_t *whole)
{
    sum_t own = SUM_OF(0.0f);
    for (int k = (int)get_local_id(0); k < count; k += (int)get_local_size(0))
        own = sum_add(own, parts[k]);
    TREE(scratch, own, sum_add, own)
    if (get_local_id(0) == 0)
        whole[0] = add ? sum_add(whole[0], own) : own;
}

/* parts = the largest x, or |x| if `absolute`, of each work-group. The host takes the largest of the parts. */
__kernel void largest_parts(
    __global const float *x, const int absolute, const long count, const long first_by, const long step, const long span,
    __local float *scratch, __global float *parts)
{
    const long first = first_by * get_global_id(0), stop = min(first + span, count);
    float own = -INFINITY;
    for (long at = first; at < stop; at += step)
        for (long k = at; k < min(at + LANES, count); ++k)
            own = fmax(own, absolute ? fabs(x[k]) : x[k]);
    TREE(scratch, own, fmax, parts[get_group_id(0)])
}

/* result = x − step y/√squares, where squares = ‖y‖²: a step of fixed length against y, or none if y is 0. The length is the
   sum of the two floats of `step` (high, low). */
__kernel void descend(
    __global const float *x, __global const float *y, const float2 step, __global const sum_t *squares, const long count,
    __global float *result)
{
    const long at = (long)get_global_id(0) * LANES, rest = count - at;
    const float share = share_of(step, squares[0]);
    if (rest > 0)
        store_some(load_some(x + at, rest) - share * load_some(y + at, rest), result + at, rest);
}
