/* Voxel-driven backprojection with FDK's distance weight: bilinear in the filtered projection.
   A work-item takes LANES voxels along x and walks the views. */
#include "common/lanes.h"

__kernel void backproject(
    __global const float *projections, /* views of (guard, (rows, pitch)) */
    __global const float *matrices,    /* (views, 12): rows give u z, v z, z of a voxel index x y z */
    __global const float *weights,     /* (views,): angular share times (DSO / DSD)^2 */
    const int views, const int rows, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int volume_pitch,
    __global float *volume)
{
    const int first = (int)get_global_id(0) * LANES, y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (first >= shape.x)
        return;
    const vf x = (vf)(first) + V_IOTA;
    vf sum = (vf)(0.0f);
    for (int f = 0; f < views; ++f) {
        __global const float *m = matrices + f * 12;
        __global const float *image = projections + f * image_step + IMAGE_GUARD;
        const vf depth = m[8] * x + (m[9] * y + m[10] * z + m[11]);
        const vf inv = 1.0f / depth;
        const vf u = (m[0] * x + (m[1] * y + m[2] * z + m[3])) * inv;
        const vf v = (m[4] * x + (m[5] * y + m[6] * z + m[7])) * inv;
        const vi inside = (u >= 0.0f) & (u <= (float)(width - 1)) & (v >= 0.0f) & (v <= (float)(rows - 1)) & (depth > 0.0f);
        const vf us = V_PICK(0.0f, u, inside), vs = V_PICK(0.0f, v, inside);
        const vf uf = min(floor(us), (float)max(width - 2, 0)), vff = min(floor(vs), (float)max(rows - 2, 0));
        const vf wu = us - uf, wv = vs - vff;
        int at[LANES];
        float low[LANES], high[LANES], below[LANES], above[LANES];
        VI_STORE(V_INT(vff) * image_pitch + V_INT(uf), at);
        const int next_row = rows > 1 ? image_pitch : 0, next = width > 1 ? 1 : 0;
        for (int lane = 0; lane < LANES; ++lane) {
            __global const float *p = image + at[lane];
            low[lane] = p[0];
            high[lane] = p[next];
            below[lane] = p[next_row];
            above[lane] = p[next_row + next];
        }
        const vf lower = V_LOAD(low) + wu * (V_LOAD(high) - V_LOAD(low));
        const vf upper = V_LOAD(below) + wu * (V_LOAD(above) - V_LOAD(below));
        sum += V_PICK(0.0f, weights[f] * inv * inv * (lower + wv * (upper - lower)), inside);
    }
    V_STORE(sum, volume + IMAGE_GUARD + ((size_t)z * shape.y + y) * volume_pitch + first);
}
