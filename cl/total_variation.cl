/* Anisotropic total variation of a small volume (guard, then (z, y, pitch)): the mean absolute difference
   between neighbours along each axis, and its gradient. A work-item takes one row of x. */
#include "common/lanes.h"

static inline vf sign_of(vf d)
{
    return V_PICK(V_PICK(0.0f, -1.0f, d < 0.0f), 1.0f, d > 0.0f);
}

__kernel void total_variation(
    __global const float *volume, const int4 shape, const int pitch, const float4 weight, /* per axis x y z */
    __global float *gradient,
    __global float *row_sums)        /* (z, y) */
{
    const int y = (int)get_global_id(0), z = (int)get_global_id(1);
    if (y >= shape.y || z >= shape.z)
        return;
    const size_t row = IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch;
    const size_t slice = (size_t)shape.y * pitch;
    vf sum = (vf)(0.0f);
    for (int x = 0; x < pitch; x += LANES) {
        const size_t at = row + x;
        if (x >= shape.x) {
            V_STORE((vf)(0.0f), gradient + at);
            continue;
        }
        const vf here = V_LOAD(volume + at);
        const vf index = (vf)(x) + V_IOTA;
        const vi last = index >= (float)(shape.x - 1), first = index < 0.5f, inside = index < (float)shape.x;
        const vf ahead = V_PICK(V_LOAD(volume + at + 1) - here, 0.0f, last);
        const vf behind = V_PICK(here - V_LOAD(volume + at - 1), 0.0f, first);
        vf total = weight.x * fabs(ahead);
        vf slope = weight.x * (sign_of(behind) - sign_of(ahead));
        if (y + 1 < shape.y) {
            const vf d = V_LOAD(volume + at + pitch) - here;
            total += weight.y * fabs(d);
            slope -= weight.y * sign_of(d);
        }
        if (y > 0)
            slope += weight.y * sign_of(here - V_LOAD(volume + at - pitch));
        if (z + 1 < shape.z) {
            const vf d = V_LOAD(volume + at + slice) - here;
            total += weight.z * fabs(d);
            slope -= weight.z * sign_of(d);
        }
        if (z > 0)
            slope += weight.z * sign_of(here - V_LOAD(volume + at - slice));
        sum += V_PICK(0.0f, total, inside);
        V_STORE(V_PICK(0.0f, slope, inside), gradient + at);
    }
    row_sums[(size_t)z * shape.y + y] = v_sum(sum);
}
