/* Tests whether a device and its compiler keep numbers exact, for `phyradgs devices --check`. Built with FP64 0, LANES 1. */
#include "common/precise.h"

/* sums = x + y z, as two floats (high, low) whose sum is the result. A compiler that reorders or fuses the operations
   loses `low`. */
__kernel void probe_pairs(
    __global const float *x, __global const float *y, __global const float *z, const int count, __global float2 *sums)
{
    const int k = (int)get_global_id(0);
    if (k >= count)
        return;
    vwide sum;
    sum.high = x[k];
    sum.low = 0.0f;
    sum = wide_product_sum(sum, (float2)(y[k], 0.0f), z[k]);
    sums[k] = (float2)(sum.high, sum.low);
}

/* Passes whole numbers through local memory, as ints and as the bits of floats, and doubles a subnormal float.
   Work-groups have 32 items. */
__kernel void probe_numbers(
    __global const int *numbers, const float subnormal, __global int *as_ints, __global float *as_floats, __global int *twice)
{
    __local int ints[32];
    __local float floats[32];
    const int k = (int)get_global_id(0), item = (int)get_local_id(0);
    ints[31 - item] = numbers[k];
    floats[31 - item] = ((__global const float *)numbers)[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    as_ints[k] = ints[item];
    as_floats[k] = floats[item];
    twice[k] = as_int(subnormal + subnormal);
}
