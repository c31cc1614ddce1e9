/* Anisotropic total variation of a small volume (guard, then (z, y, pitch)), which is the weighted sum of absolute
   differences between neighbours along each axis; and its gradient. On a CPU a work-item takes all vectors of a row, on a
   GPU one voxel. */
#include "common/lanes.h"
#include "common/group_sums.h"

static inline vf sign_of(vf d)
{
    return V_PICK(V_PICK(0.0f, -1.0f, d < 0.0f), 1.0f, d > 0.0f);
}

__kernel void total_variation(
    __global const float *volume, const int4 shape, const int pitch, const float4 weight, /* weight of each axis x, y, z */
    __global float *gradient,
    __local float *tree,             /* scratch for sums: a float per work-item of a group */
    __global float *sums)            /* (groups): the total variation of each work-group's voxels */
{
    const int y = (int)get_global_id(1), z = (int)get_global_id(2);
    const int stop = y < shape.y ? pitch : 0;
    const size_t row = IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch;
    const size_t slice = (size_t)shape.y * pitch;
    vf sum = (vf)(0.0f);
    for (int x = (int)get_global_id(0) * LANES; x < stop; x += (int)get_global_size(0) * LANES) {
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
    const float own = v_sum(sum);
    group_sums(&own, 1, tree, sums + (get_group_id(2) * get_num_groups(1) + get_group_id(1)) * get_num_groups(0) + get_group_id(0));
}
