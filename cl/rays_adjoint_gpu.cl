/* Adjoint of rays.cl for GPUs. A work-item takes a voxel, and sums over the rays whose samples touch it. A work-group takes
   a block of 4 x 4 x 4 voxels, or fewer along z. Its items search together for the time cells that see the block. */
#include "common/ray.h"
#include "common/ray_window.h"

#define BLOCK 4        /* voxels along each side of a work-group's block; _BLOCK in operators/rays/general.py */
#ifndef BLOCK_Z
#define BLOCK_Z BLOCK
#endif
#define FEW_CELLS 8    /* with at most this many time cells in a frame, searching would take longer than trying all */

/* If a voxel is farther from the source along one axis than along the others by more than this, in voxels, that axis is the
   main one of all rays that touch the voxel. */
#define SURELY 1.001f

/* Sums the window's pixels of a cell, times the voxel's weight in the samples of their rays on planes across axis a. sure: all
   rays that touch the voxel have this main axis; else each ray is tested. of[v]: the weight of line v. UPRIGHT: pixels lie
   in columns along z, so the rays of column p have the same weight across it, unless a is z. 1: lines are rows. 2: lines are
   columns. */
RAY_INLINE float from_planes(__global const float *frame, const int image_pitch, __global const float *of, const window_t w,
                             __global const float *cell, const float4 pitch_mm, const int4 voxel, const int a, const int sure)
{
    const int b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2, by_rows = UPRIGHT != 2;
    const float i = (float)(a == 0 ? voxel.x : (a == 1 ? voxel.y : voxel.z));
    const float j = (float)(a == 0 ? voxel.y : voxel.x), k = (float)(a == 2 ? voxel.y : voxel.z);
    const float pa = a == 0 ? pitch_mm.x : (a == 1 ? pitch_mm.y : pitch_mm.z);
    const float pb = a == 0 ? pitch_mm.y : pitch_mm.x, pc = a == 2 ? pitch_mm.y : pitch_mm.z;
    const float sa = cell[RAY_SOURCE + a], ahead = AHEAD_OF(sa, i);
    const float b_from = START_OF(cell[RAY_SOURCE + b], i) - j, c_from = START_OF(cell[RAY_SOURCE + c], i) - k;
    __global const float *d = cell + RAY_D00, *ep = cell + (by_rows ? RAY_EU : RAY_EV), *eq = cell + (by_rows ? RAY_EV : RAY_EU);
    const int p_lo = by_rows ? w.u_lo : w.v_lo, p_hi = by_rows ? w.u_hi : w.v_hi;
    const int q_lo = by_rows ? w.v_lo : w.u_lo, q_hi = by_rows ? w.v_hi : w.u_hi;
    float sum = 0.0f;
    for (int p = p_lo; p <= p_hi; ++p) {
        const float a0 = fma((float)p, ep[a], d[a]), b0 = fma((float)p, ep[b], d[b]), c0 = fma((float)p, ep[c], d[c]);
        float da = a0, db = b0, inv = 1.0f / da, wb = 1.0f - fabs(fma(db, ahead * inv, b_from));
        for (int q = q_lo; q <= q_hi; ++q) {
            if (!UPRIGHT || a == 2) {
                da = fma((float)q, eq[a], a0);
                db = fma((float)q, eq[b], b0);
                inv = 1.0f / da;
                wb = 1.0f - fabs(fma(db, ahead * inv, b_from));
            }
            const float dc = fma((float)q, eq[c], c0), wc = 1.0f - fabs(fma(dc, ahead * inv, c_from));
            const int u = by_rows ? p : q, v = by_rows ? q : p;
            if (!(wb > 0.0f && wc > 0.0f) || (!sure && rays_through(cell, pitch_mm, (float)u, (float)v).axis != a))
                continue;
#if RAY_PARALLEL
            const float lb = cell[RAY_SOURCE + b] * pb, lc = cell[RAY_SOURCE + c] * pc;
#else
            if (i < min(sa, sa + da) || i > max(sa, sa + da)) /* behind the source, or the panel */
                continue;
            const float lb = db * inv * pb, lc = dc * inv * pc;
#endif
            sum = fma(of[v] * frame[(size_t)v * image_pitch + u], wb * wc * sqrt(fma(pa, pa, fma(lb, lb, lc * lc))), sum);
        }
    }
    return sum;
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
    const float4 around = 0.5f * ((float4)(BLOCK, BLOCK, BLOCK_Z, BLOCK) + 1.0f), middle = convert_float4(corner) + around - 1.0f;
    float sum = inside && add ? *to : 0.0f;
    for (int n = frame_first; n < frame_stop; ++n) {
        __global const float *frame = image + IMAGE_GUARD + (size_t)n * lines * image_pitch;
        int first = frame_cells[frame_list[n]], stop = frame_cells[frame_list[n] + 1];
        window_t w;
        if (stop - first > FEW_CELLS) { /* the same for all items of a group, as barriers need */
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item < 2)
                range[item] = item ? first : stop;
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
            __global const float *cell = cells + (size_t)c * RAY_CELL;
            const float4 from = vload4(0, cell + RAY_SOURCE), far = fabs(RAY_PARALLEL ? from : convert_float4(voxel) - from);
            const int main = far.x >= far.y && far.x >= far.z ? 0 : (far.y >= far.z ? 1 : 2);
            const float next = main == 0 ? fmax(far.y, far.z) : (main == 1 ? fmax(far.x, far.z) : fmax(far.x, far.y));
            const int sure = RAY_PARALLEL || fmax(fmax(far.x, far.y), far.z) > next + SURELY;
            __global const float *of = weights + weight_at[c] - cell_lines[2 * c];
            for (int axis = sure ? main : 0; axis <= (sure ? main : 2); ++axis) {
                const float4 around_it = (float4)(axis != 0, axis != 1, axis != 2, 0.0f); /* only one plane across the axis */
                if (window_of(matrices, matrix_stride, cell_lines, width, c, stop, convert_float4(voxel), around_it, &w))
                    sum += from_planes(frame, image_pitch, of, w, cell, pitch_mm, voxel, axis, sure);
            }
        }
    }
    if (inside)
        *to = sum;
}
