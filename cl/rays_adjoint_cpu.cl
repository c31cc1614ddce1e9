/* Adjoint of rays.cl for CPUs. A work-item takes a box of voxels. It follows the rays that may meet the box plane by plane,
   as the projector does, and adds to voxels in a tile of local memory. The tile has a border of one voxel, whose sums are
   not used: the neighbouring work-items compute them too. So one work-item sums for a voxel, in a fixed order, without
   atomics. */
#include "common/ray.h"
#include "common/ray_window.h"

#define TILE_X (BRICK_X + 2)
#define TILE_Y (BRICK_Y + 2)
#define TILE_Z (BRICK_Z + 2)

/* Backprojects pixels u_lo..u_hi of a line, from one cell, into the tile. row: the line's pixels. own: the cell's weights. */
RAY_INLINE void line_onto(__global const float *cell, __global const float *row, __global const float *own, const float4 pitch_mm,
                          const int u_lo, const int u_hi, const int v, const int4 corner, const int4 size,
                          __local float *tile)
{
    for (int u = u_lo; u <= u_hi; u += LANES) {
        const vi real = VI_IOTA + u <= u_hi;
        const rays_t r = rays_through(cell, pitch_mm, (float)u + V_IOTA, (float)v);
        const vf value = V_LOAD(row + u) * (weight_of(own, u, v) * r.step_mm);
        if (!V_ANY(value != 0.0f)) /* masked pixels, or air */
            continue;
        for (int axis = 0; axis < 3; ++axis) {
            walk_t w;
            if (!rays_enter(r, cell, axis, real, corner, size, &w))
                continue;
            const int sa = axis == 0 ? 1 : (axis == 1 ? TILE_X : TILE_X * TILE_Y);
            const int sb = axis == 0 ? TILE_X : 1, sc = axis == 2 ? TILE_X : TILE_X * TILE_Y;
            __local float *body = tile + (1 - w.a_first) * sa + (1 - w.b_first) * sb + (1 - w.c_first) * sc;
            for (int i = w.lo; i <= w.hi; ++i) {
                vf wb, wc;
                const vi j = sample_at(w.gb, START_OF(w.sb, i), AHEAD_OF(w.sa, i), w.b_first, w.b_last, &wb);
                const vi k = sample_at(w.gc, START_OF(w.sc, i), AHEAD_OF(w.sa, i), w.c_first, w.c_last, &wc);
                const vf h = V_PICK(0.0f, value, (w.first <= i) & (w.last >= i));
                const vf far = h * wc, near = h - far;
                vf h10 = near * wb, h11 = far * wb, h00 = near - h10, h01 = far - h11;
                vi at = j * sb + k * sc + i * sa;
                #pragma unroll
                for (int lane = 0; lane < LANES; ++lane) {
                    __local float *own = body + LANE(int, at, lane);
                    own[0] += LANE(float, h00, lane);
                    own[sb] += LANE(float, h10, lane);
                    own[sc] += LANE(float, h01, lane);
                    own[sb + sc] += LANE(float, h11, lane);
                }
            }
        }
    }
}

__kernel void rays_adjoint(
    __global const float *image,      /* guard, then (listed frames, lines, pitch) */
    __global const float *cells, __global const int *cell_lines,
    __global const float *matrices,   /* (12, matrix_stride): rows give u d, v d, depth d of a voxel */
    const int matrix_stride,
    __global const int *frame_cells,  /* (F + 1,): where a frame's cells begin */
    __global const int *frame_list, __global const float *weights, __global const int *weight_at,
    const int frame_first, const int frame_stop,
    const int4 shape, const int4 origin, const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int add,
    __global float *volume)
{
    __local float tile[TILE_X * TILE_Y * TILE_Z]; /* the group has only one work-item */
    const int4 own = (int4)((int)get_group_id(0) * BRICK_X, (int)get_group_id(1) * BRICK_Y,
                            (int)get_group_id(2) * BRICK_Z, 0); /* own: first voxel in this volume; corner: in the grid */
    const int4 corner = origin + own, size = min((int4)(BRICK_X, BRICK_Y, BRICK_Z, 0), shape - own);
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global float *voxels = volume + IMAGE_GUARD + (own.z + BORDER) * sz + (own.y + BORDER) * sy + own.x;
    const float4 half_size = convert_float4(size + 1) * 0.5f; /* includes the border */
    const float4 middle = convert_float4(corner) + convert_float4(size - 1) * 0.5f;
    for (int k = 0; k < TILE_X * TILE_Y * TILE_Z; ++k)
        tile[k] = 0.0f;
    if (add) /* begins with the old values, so that the order of sums does not depend on the number of launches */
        for (int z = 0; z < size.z; ++z)
            for (int y = 0; y < size.y; ++y)
                for (int x = 0; x < size.x; ++x)
                    tile[((z + 1) * TILE_Y + y + 1) * TILE_X + x + 1] = voxels[z * sz + y * sy + x];
    for (int n = frame_first; n < frame_stop; ++n) {
        __global const float *frame = image + IMAGE_GUARD + (size_t)n * lines * image_pitch;
        const int stop = frame_cells[frame_list[n] + 1];
        for (int c = frame_cells[frame_list[n]]; c < stop; c += LANES) {
            window_t w;
            vi is_met = window_of(matrices, matrix_stride, cell_lines, ACROSS ? lines : width, c, stop, middle, half_size, &w);
            if (!V_ANY(is_met))
                continue;
            for (int lane = 0; lane < LANES; ++lane) {
                if (!LANE(int, is_met, lane))
                    continue;
                __global const float *cell = cells + (size_t)(c + lane) * RAY_CELL;
                __global const float *own = weights + weight_at[c + lane] - cell_lines[2 * (c + lane)];
                for (int v = LANE(int, w.v_lo, lane); v <= LANE(int, w.v_hi, lane); ++v)
                    line_onto(cell, frame + (size_t)v * image_pitch, own, pitch_mm, LANE(int, w.u_lo, lane),
                              LANE(int, w.u_hi, lane), v, corner, size, tile);
            }
        }
    }
    for (int z = 0; z < size.z; ++z)
        for (int y = 0; y < size.y; ++y)
            for (int x = 0; x < size.x; ++x)
                voxels[z * sz + y * sy + x] = tile[((z + 1) * TILE_Y + y + 1) * TILE_X + x + 1];
}
