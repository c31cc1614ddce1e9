/* Adjoint of rays.cl for GPUs. A work-item takes a voxel, and sums over the rays whose samples touch it. A work-group takes
   a block of 4 x 4 x 4 voxels, or fewer along z. Its items search together for the time cells that see the block. */
#include "common/ray.h"
#include "common/ray_window.h"

#define BLOCK 4        /* voxels along each side of a work-group's block; _BLOCK in operators/rays/general.py */
#ifndef BLOCK_Z
#define BLOCK_Z BLOCK
#endif
#define FEW_CELLS 8    /* with at most this many time cells in a frame, searching would take longer than trying all */

/* The weight of the voxel in the ray's samples, times the length of ray per sample, as in rays_forward. */
static inline float ray_weight(const rays_t r, __global const float *cell, const int4 voxel)
{
    const int a = r.axis, b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
    const float da = a == 0 ? r.x : (a == 1 ? r.y : r.z), db = a == 0 ? r.y : r.x, dc = a == 2 ? r.y : r.z;
    const float i = (float)(a == 0 ? voxel.x : (a == 1 ? voxel.y : voxel.z));
    const float j = (float)(a == 0 ? voxel.y : voxel.x), k = (float)(a == 2 ? voxel.y : voxel.z);
    const float sa = cell[RAY_SOURCE + a];
#if !RAY_PARALLEL
    if (i < min(sa, sa + da) || i > max(sa, sa + da))
        return 0.0f;
#endif
    const float inv = 1.0f / da;
    const float wb = 1.0f - fabs(fma(db * inv, AHEAD_OF(sa, i), START_OF(cell[RAY_SOURCE + b], i)) - j);
    const float wc = 1.0f - fabs(fma(dc * inv, AHEAD_OF(sa, i), START_OF(cell[RAY_SOURCE + c], i)) - k);
    return wb > 0.0f && wc > 0.0f ? wb * wc * r.step_mm : 0.0f;
}

__kernel void rays_adjoint(
    __global const float *image, __global const float *cells, __global const int *cell_lines,
    __global const float *matrices, const int matrix_stride,
    __global const int *frame_cells, __global const int *frame_list,
    __global const float *weights, __global const int *weight_at, const int frame_first, const int frame_stop,
    const int4 shape, const int4 origin, const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int add,
    __global float *volume)
{
    __local int range[2]; /* the first cell that sees the block, and the last + 1 */
    const int item = (int)get_local_id(0), items = (int)get_local_size(0);
    const int4 block = (int4)((int)get_global_id(0) / items * BLOCK, (int)get_global_id(1) * BLOCK,
                              (int)get_global_id(2) * BLOCK_Z, 0); /* the group's id restarts in each part of a launch */
    const int4 own = block + (int4)(item % BLOCK, (item / BLOCK) % BLOCK, item / (BLOCK * BLOCK), 0);
    const int4 corner = origin + block, voxel = origin + own; /* indices in the grid; own and block are in this volume */
    const int inside = own.x < shape.x && own.y < shape.y && own.z < shape.z;
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global float *to = volume + IMAGE_GUARD + (own.z + BORDER) * sz + (own.y + BORDER) * sy + own.x;
    const float4 sides = (float4)(BLOCK, BLOCK, BLOCK_Z, BLOCK);
    const float4 around = 0.5f * (sides + 1.0f), middle = convert_float4(corner) + 0.5f * (sides - 1.0f);
    float sum = inside && add ? *to : 0.0f;
    for (int n = frame_first; n < frame_stop; ++n) {
        __global const float *frame = image + IMAGE_GUARD + (size_t)n * lines * image_pitch;
        int first = frame_cells[frame_list[n]], stop = frame_cells[frame_list[n] + 1];
        window_t w;
        if (stop - first > FEW_CELLS) { /* the same for all items of a group, as barriers need */
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item == 0) {
                range[0] = stop;
                range[1] = first;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int c = first + item; c < stop; c += items)
                if (window_of(matrices, matrix_stride, cell_lines, width, c, stop, middle, around, &w)) {
                    atomic_min(&range[0], c); /* integers: the result does not depend on the order */
                    atomic_max(&range[1], c + 1);
                }
            barrier(CLK_LOCAL_MEM_FENCE);
            first = range[0];
            stop = range[1];
        }
        for (int c = first; inside && c < stop; ++c) {
            if (!window_of(matrices, matrix_stride, cell_lines, width, c, stop, convert_float4(voxel), (float4)(1.0f), &w))
                continue;
            __global const float *cell = cells + (size_t)c * RAY_CELL;
            __global const float *own = weights + weight_at[c] - cell_lines[2 * c];
            for (int v = w.v_lo; v <= w.v_hi; ++v) {
                float from_line = 0.0f;
                for (int u = w.u_lo; u <= w.u_hi; ++u)
                    from_line += frame[(size_t)v * image_pitch + u]
                                 * ray_weight(rays_through(cell, pitch_mm, (float)u, (float)v), cell, voxel);
                sum += own[v] * from_line;
            }
        }
    }
    if (inside)
        *to = sum;
}
