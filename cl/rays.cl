/* Ray-driven projector by Joseph's method and its exactly matched adjoint, over all time cells of many frames in
   as few launches as may last. Joseph, IEEE Trans. Med. Imaging 1 (1982) 192: one bilinear sample per plane of the ray's main
   axis. Frames are padded rows, volumes too, with a border of zeros in y and z. AVERAGE: of a line's cells, in the forward
   kernel. Twin: operators/twins/rays.py. */
#include "common/intensity.h"
#include "common/ray.h"
#include "common/ray_window.h"

#define AVERAGE_LOG 0       /* sum of w p */
#define AVERAGE_INTENSITY 1 /* -log of the sum of w exp(-p) */
#define AVERAGE_CORRECTION 2       /* the first less the second, from differences between cells: no cancellation */

__kernel void rays_forward(
    __global const float *volume,     /* guard, then (z, y, pitch) with a border of BORDER in y and z */
    __global const float *cells,      /* (C, RAY_CELL), frame after frame */
    __global const int *cell_lines,   /* (C, 2): first line of a cell and the one after its last */
    __global const int *line_cells,   /* (F, lines, 2): first cell and cell after the last that may serve a line */
    __global const int *frame_list,   /* which frames */
    __global const float *weights, __global const int *weight_at, /* of each cell's lines, and where they begin */
    const int4 shape, const int4 origin, /* voxels of the volume, and the first of them in the grid, x y z */
    const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int frame_first,            /* in the list */
    const int add,                    /* onto the image: the log average of one more brick */
    __global float *image)            /* guard, then (listed frames, lines, pitch) */
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1), n = frame_first + (int)get_global_id(2);
    if (u >= width)
        return;
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global const float *body = volume + IMAGE_GUARD + (sy + sz) * BORDER;
    const size_t line = (size_t)frame_list[n] * lines + v;
    const vi real = VI_IOTA + u < width;
    vf total = (vf)(0.0f);
    intensity_t sum = intensity_from(total);
    int any = 0;
    for (int c = line_cells[2 * line]; c < line_cells[2 * line + 1]; ++c) {
        if (v < cell_lines[2 * c] || v >= cell_lines[2 * c + 1])
            continue;
        __global const float *cell = cells + (size_t)c * RAY_CELL;
        const rays_t r = rays_through(cell, pitch_mm, (float)u + V_IOTA, (float)v);
        vf p = (vf)(0.0f);
        for (int axis = 0; axis < 3; ++axis) {
            walk_t w;
            if (!rays_enter(r, cell, axis, real, origin, shape, &w))
                continue;
            const index_t sa = axis == 0 ? 1 : (axis == 1 ? sy : sz), sb = axis == 0 ? sy : 1, sc = axis == 2 ? sy : sz;
            for (int i = w.lo; i <= w.hi; ++i) {
                vf wb, wc, v00, v10, v01, v11;
                const vi j = sample_at(w.gb, w.sb, (float)i - w.sa, w.b_first, w.b_last, &wb);
                const vi k = sample_at(w.gc, w.sc, (float)i - w.sa, w.c_first, w.c_last, &wc);
                vindex at = V_INDEX(j - w.b_first) * sb + V_INDEX(k - w.c_first) * sc;
                __global const float *plane = body + (i - w.a_first) * sa;
                #pragma unroll
                for (int lane = 0; lane < LANES; ++lane) {
                    __global const float *corner = plane + LANE(index_t, at, lane);
                    LANE(float, v00, lane) = corner[0];
                    LANE(float, v10, lane) = corner[sb];
                    LANE(float, v01, lane) = corner[sc];
                    LANE(float, v11, lane) = corner[sb + sc];
                }
                const vf near = fma(wb, v10 - v00, v00), far = fma(wb, v11 - v01, v01);
                p += V_PICK(0.0f, fma(wc, far - near, near), (w.first <= i) & (w.last >= i));
            }
        }
        p *= r.step_mm;
        const float weight = weights[weight_at[c] + v - cell_lines[2 * c]];
        if (AVERAGE == AVERAGE_LOG) {
            total += weight * p;
            continue;
        }
        if (!any)
            sum = intensity_from(p);
        any = 1;
        intensity_add(&sum, (vf)(weight), p);
    }
    if (AVERAGE != AVERAGE_LOG && any)
        total = AVERAGE == AVERAGE_CORRECTION ? sum.mean + intensity_brighter(sum) : sum.from - intensity_brighter(sum);
    __global float *pixels = image + IMAGE_GUARD + ((size_t)n * lines + v) * image_pitch + u;
    if (add)
        total += V_LOAD(pixels);
    V_STORE(V_PICK(0.0f, total, real), pixels);
}

#if !RAY_VOXEL_ITEMS
/* Adjoint for CPUs: a work-item owns a brick of voxels. It follows the rays that may meet its brick, plane by plane as
   the projector does, and adds their shares into a tile of its own; a border of one voxel catches what belongs to
   neighbours, who find it themselves. One writer per voxel in a fixed order: no atomics. */
#define TILE_X (BRICK_X + 2)
#define TILE_Y (BRICK_Y + 2)
#define TILE_Z (BRICK_Z + 2)

/* rays u_lo..u_hi of one line and cell onto the tile; row: the line's values; weight: of the line in the cell */
RAY_INLINE void line_onto(__global const float *cell, __global const float *row, const float weight, const float4 pitch_mm,
                          const int u_lo, const int u_hi, const int v, const int4 corner, const int4 size,
                          __local float *tile)
{
    for (int u = u_lo; u <= u_hi; u += LANES) {
        const vi real = VI_IOTA + u <= u_hi;
        const rays_t r = rays_through(cell, pitch_mm, (float)u + V_IOTA, (float)v);
        const vf value = V_LOAD(row + u) * (weight * r.step_mm);
        if (!V_ANY(value != 0.0f)) /* masked pixels, air */
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
                const vi j = sample_at(w.gb, w.sb, (float)i - w.sa, w.b_first, w.b_last, &wb);
                const vi k = sample_at(w.gc, w.sc, (float)i - w.sa, w.c_first, w.c_last, &wc);
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
    __global const float *matrices,   /* (12, matrix_stride): rows give u z, v z, z of a voxel index */
    const int matrix_stride,
    __global const int *frame_cells,  /* (F + 1,): where a frame's cells begin */
    __global const int *frame_list, __global const float *weights, __global const int *weight_at,
    const int frame_first, const int frame_stop,
    const int4 shape, const int4 origin, const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int add,
    __global float *volume)
{
    __local float tile[TILE_X * TILE_Y * TILE_Z]; /* of the one work-item in the group */
    const int4 own = (int4)((int)get_group_id(0) * BRICK_X, (int)get_group_id(1) * BRICK_Y,
                            (int)get_group_id(2) * BRICK_Z, 0); /* first voxel, in this volume; corner: in the grid */
    const int4 corner = origin + own, size = min((int4)(BRICK_X, BRICK_Y, BRICK_Z, 0), shape - own);
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global float *voxels = volume + IMAGE_GUARD + (own.z + BORDER) * sz + (own.y + BORDER) * sy + own.x;
    const float4 half_size = convert_float4(size + 1) * 0.5f; /* with the border */
    const float4 middle = convert_float4(corner) + convert_float4(size - 1) * 0.5f;
    for (int k = 0; k < TILE_X * TILE_Y * TILE_Z; ++k)
        tile[k] = 0.0f;
    if (add) /* first, so that frames sum up in one order however many launches they take */
        for (int z = 0; z < size.z; ++z)
            for (int y = 0; y < size.y; ++y)
                for (int x = 0; x < size.x; ++x)
                    tile[((z + 1) * TILE_Y + y + 1) * TILE_X + x + 1] = voxels[z * sz + y * sy + x];
    for (int n = frame_first; n < frame_stop; ++n) {
        __global const float *frame = image + IMAGE_GUARD + (size_t)n * lines * image_pitch;
        const int stop = frame_cells[frame_list[n] + 1];
        for (int c = frame_cells[frame_list[n]]; c < stop; c += LANES) {
            window_t w;
            vi seen = window_of(matrices, matrix_stride, cell_lines, width, c, stop, middle, half_size, &w);
            if (!V_ANY(seen))
                continue;
            for (int lane = 0; lane < LANES; ++lane) {
                if (!LANE(int, seen, lane))
                    continue;
                __global const float *cell = cells + (size_t)(c + lane) * RAY_CELL;
                __global const float *own = weights + weight_at[c + lane] - cell_lines[2 * (c + lane)];
                for (int v = LANE(int, w.v_lo, lane); v <= LANE(int, w.v_hi, lane); ++v)
                    line_onto(cell, frame + (size_t)v * image_pitch, own[v], pitch_mm, LANE(int, w.u_lo, lane),
                              LANE(int, w.u_hi, lane), v, corner, size, tile);
            }
        }
    }
    for (int z = 0; z < size.z; ++z)
        for (int y = 0; y < size.y; ++y)
            for (int x = 0; x < size.x; ++x)
                voxels[z * sz + y * sy + x] = tile[((z + 1) * TILE_Y + y + 1) * TILE_X + x + 1];
}

#else
/* Adjoint for GPUs: a work-item is a voxel and gathers from the rays whose samples weigh it; a work-group is a block of
   4 x 4 x 4 voxels, which looks for its cells together. */
#define BLOCK 4
#define FEW_CELLS 8    /* a frame of so few is not worth the search */

/* weight that the ray's sample puts on the voxel, as rays_forward does */
static inline float ray_weight(const rays_t r, __global const float *cell, const int4 voxel)
{
    const int a = r.axis, b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
    const float da = a == 0 ? r.x : (a == 1 ? r.y : r.z), db = a == 0 ? r.y : r.x, dc = a == 2 ? r.y : r.z;
    const float i = (float)(a == 0 ? voxel.x : (a == 1 ? voxel.y : voxel.z));
    const float j = (float)(a == 0 ? voxel.y : voxel.x), k = (float)(a == 2 ? voxel.y : voxel.z);
    const float sa = cell[RAY_SOURCE + a];
    if (i < min(sa, sa + da) || i > max(sa, sa + da))
        return 0.0f;
    const float inv = 1.0f / da;
    const float wb = 1.0f - fabs(fma(db * inv, i - sa, cell[RAY_SOURCE + b]) - j);
    const float wc = 1.0f - fabs(fma(dc * inv, i - sa, cell[RAY_SOURCE + c]) - k);
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
    __local int range[2]; /* cells outside of which none sees the block */
    const int item = (int)get_local_id(0), items = (int)get_local_size(0);
    const int4 block = (int4)((int)get_group_id(0), (int)get_group_id(1), (int)get_group_id(2), 0) * BLOCK;
    const int4 own = block + (int4)(item % BLOCK, (item / BLOCK) % BLOCK, item / (BLOCK * BLOCK), 0);
    const int4 corner = origin + block, voxel = origin + own; /* in the grid; own, block: in this volume */
    const int inside = own.x < shape.x && own.y < shape.y && own.z < shape.z;
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global float *to = volume + IMAGE_GUARD + (own.z + BORDER) * sz + (own.y + BORDER) * sy + own.x;
    const float4 around = (float4)(0.5f * (BLOCK + 1)), middle = convert_float4(corner) + 0.5f * (BLOCK - 1);
    float sum = inside && add ? *to : 0.0f;
    for (int n = frame_first; n < frame_stop; ++n) {
        __global const float *frame = image + IMAGE_GUARD + (size_t)n * lines * image_pitch;
        int first = frame_cells[frame_list[n]], stop = frame_cells[frame_list[n] + 1];
        window_t w;
        if (stop - first > FEW_CELLS) { /* the same for the whole group */
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item == 0) {
                range[0] = stop;
                range[1] = first;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int c = first + item; c < stop; c += items)
                if (window_of(matrices, matrix_stride, cell_lines, width, c, stop, middle, around, &w)) {
                    atomic_min(&range[0], c); /* integers: the order does not matter */
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
#endif
