/* Draws the splats of all time cells into the merged frame. Every tile sums its list of splats over the cells that serve its
   lines, so that micro-views are accumulated and strips joined (paper, Eq. 3) in one pass.
   splat_forward_rows: a work-item takes some complete lines and adds vectors of pixels (CPUs).
   splat_forward_pixels: a work-group takes a tile, whose records it reads once; several work-items share a pixel (GPUs).
   Each pixel is written by one work-item, without atomics. */
#if BLOCK_PIXEL
#define SPLAT_SPACE __local
#endif
#include "common/footprint.h"
#include "common/tile.h"

/* Adds a moving splat to the pixels of a line. Each integration rule has its own loop, so that no pixel tests the rule. */
#define ADD_PIXELS(rule)                                                                            \
    for (int u = line.u_lo; u <= line.u_hi; u += LANES) {                                           \
        const moving_pixel p = moving_at(line.s, (float)u + V_IOTA, footprint_du(line, u), limit);  \
        V_STORE(V_LOAD(row + u) + V_PICK(0.0f, moving_value(rule, line.s, p), p.drawn), row + u);   \
    }

#if MOVING
ALWAYS_INLINE void add_line(const footprint_line line, const float limit, __global float *row)
{
    if (line.s.rule == CLOSED)
        ADD_PIXELS(CLOSED)
    else if (line.s.rule == 1)
        ADD_PIXELS(1)
    else if (line.s.rule == 2)
        ADD_PIXELS(2)
    else
        ADD_PIXELS(3)
}

/* The values at LANES pixels from u on; 0 beyond the cutoff. */
ALWAYS_INLINE vf value_at(const footprint_line line, const int u, const float limit)
{
    const moving_pixel p = moving_at(line.s, (float)u + V_IOTA, footprint_du(line, u), limit);
    return V_PICK(0.0f, moving_value(line.s.rule, line.s, p), p.drawn);
}
#else
ALWAYS_INLINE vf value_at(const footprint_line line, const int u, const float limit)
{
    vf num, b, rq;
    const vf value = splat_value(line.s, (float)u + V_IOTA, footprint_du(line, u), &num, &b, &rq);
    return V_PICK(0.0f, value, num * rq <= limit);
}

ALWAYS_INLINE void add_line(const footprint_line line, const float limit, __global float *row)
{
    for (int u = line.u_lo; u <= line.u_hi; u += LANES)
        V_STORE(V_LOAD(row + u) + value_at(line, u, limit), row + u);
}
#endif

#define ARGUMENTS                                                                                                       \
    __global const float *records,    /* (stride, C, RECORD), from splat_prepare.cl */                                  \
    __global const uchar *is_visible, /* (stride, C): 1 where a splat has a record */                                   \
    __global const float *cells,      /* (C, CELL): the time cells of the frame */                                      \
    __global const int *line_cells,   /* (lines, 2): first cell, and the cell after the last, that serve a line */      \
    __global const float *line_times, /* MOVING: (C, TIME_ROWS, time_pitch) */                                          \
    const int time_pitch,                                                                                               \
    const float4 path_limits,         /* MOVING: the longest paths for 1, 2 and 3 times (common/splat_moving.h) */      \
    __global const int *tile_offsets, /* (tiles + 1,): where each tile's list of splats begins */                       \
    __global const int *tile_splat_ids, const int capacity, const int count,                                            \
    const int cell_count, const int lines, const int width, const int pitch,                                            \
    const int tile_w, const int tile_h, const int tiles_u, const float cutoff2,                                         \
    const int layer_count,            /* LAYERED: number of images, each a guard and (lines, pitch) */                  \
    __global float *image             /* IMAGE_GUARD floats, then the image (lines, pitch) */

#if BLOCK_PIXEL
#define STAGED 64 /* number of records that a work-group reads into local memory at a time */
#define MOST_ITEMS 256

/* Groups have tile_w by tile_h by `parts` items (a power of 2), because few tiles with long lists would leave a GPU idle. The
   items of a pixel divide the records by index, so that sums do not depend on whether lists were written. LAYERED: they divide
   the cells, whose layers differ at a pixel. Cells are sorted: the first and last line give those of all lines of a tile. */
__kernel void splat_forward_pixels(ARGUMENTS)
{
    __local int records_here[STAGED * RECORD]; /* as ints: copied as floats, a device may set small ints to 0 */
    __local float cells_here[STAGED * CELL];
    __local int place[STAGED], cell_of[STAGED]; /* index in records, -1 if not visible in this tile; and its cell */
    __local float sums[MOST_ITEMS];
    const int u = (int)get_global_id(0), v = (int)get_global_id(1);
    const int part = (int)get_local_id(2), parts = (int)get_local_size(2), pixels = (int)(get_local_size(0) * get_local_size(1));
    const int pixel = (int)(get_local_id(1) * get_local_size(0) + get_local_id(0));
    const int item = part * pixels + pixel, items = parts * pixels;
    /* Not from get_group_id, which restarts in each part of a launch. */
    const int left = u - (int)get_local_id(0), top = v - (int)get_local_id(1);
    const int right = min(left + tile_w, width) - 1, bottom = min(top + tile_h, lines) - 1;
    const int tile = top / tile_h * tiles_u + left / tile_w;
    const tile_list list = list_of(tile_offsets, tile, capacity, count);
    const int c_first = line_cells[2 * top], c_count = line_cells[2 * bottom + 1] - c_first;
    const int inside = u < width && v < lines;
    const int own_first = line_cells[2 * min(v, bottom)], own_stop = inside ? line_cells[2 * v + 1] : own_first;
    const size_t at = IMAGE_GUARD + (size_t)v * pitch + u, layer_size = IMAGE_GUARD + (size_t)lines * pitch;
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
#if LAYERED
    for (int layer = part; inside && layer < layer_count; layer += parts)
        image[layer * layer_size + at] = 0.0f;
    barrier(CLK_GLOBAL_MEM_FENCE);
#endif
    float sum = 0.0f;
    for (int done = 0; done < list.count * c_count; done += STAGED) {
        const int here = min(STAGED, list.count * c_count - done);
        barrier(CLK_LOCAL_MEM_FENCE); /* waits until all items have read the last records */
        for (int k = item; k < here; k += items) {
            const int e = (done + k) / c_count, c = c_first + (done + k) % c_count;
            const int splat = listed_splat(list, tile_splat_ids, e) * cell_count + c;
            int is_here = is_visible[splat];
            if (is_here) {
                __global const int *record_as_int = (__global const int *)(records + (size_t)splat * RECORD);
                is_here = record_as_int[REC_U_LO] <= right && record_as_int[REC_U_HI] >= left &&
                          record_as_int[REC_V_LO] <= bottom && record_as_int[REC_V_HI] >= top;
            }
            place[k] = is_here ? splat : -1;
            cell_of[k] = c;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int f = item; f < here * RECORD; f += items)
            if (place[f / RECORD] >= 0)
                records_here[f] = ((__global const int *)records)[(size_t)place[f / RECORD] * RECORD + f % RECORD];
        for (int f = item; f < here * CELL; f += items)
            cells_here[f] = cells[cell_of[f / CELL] * CELL + f % CELL];
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int k = 0; k < here; ++k) {
            const int c = cell_of[k];
            if (place[k] < 0 || ((LAYERED ? c : place[k]) & (parts - 1)) != part || c < own_first || c >= own_stop)
                continue;
            __local const int *record_as_int = records_here + k * RECORD;
            __local const float *splat_record = (__local const float *)record_as_int, *cell = cells_here + k * CELL;
            if (v < record_as_int[REC_V_LO] || v > record_as_int[REC_V_HI] || u < record_as_int[REC_U_LO] || u > record_as_int[REC_U_HI])
                continue;
            const footprint_line line = footprint_alone(splat_record, cell, TIMES_OF(c, line_times, time_pitch), time_pitch, v,
                                                        path_limits);
            const float value = value_at(line, u, limit);
#if LAYERED
            image[LAYER_AT(cell, lines, pitch) + at] += value;
#else
            sum += value;
#endif
        }
    }
#if !LAYERED
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (part == 0 && inside) {
        for (int p = 1; p < parts; ++p)
            sum += sums[p * pixels + pixel];
        image[at] = sum;
    }
#endif
}
#else
typedef struct { __global float *image; int pitch; float limit; } painter;

ALWAYS_INLINE void visit(painter *own, const footprint_line line)
{
    add_line(line, own->limit, own->image + IMAGE_GUARD + (size_t)line.v * own->pitch);
}

#define VISITOR painter
#include "common/footprint_walk.h"

__kernel void splat_forward_rows(ARGUMENTS)
{
    const int tile = (int)get_global_id(0);
    const int top = tile * tile_h;
    if (top >= lines)
        return;
    const int bottom = min(top + tile_h, lines) - 1;
    const size_t layer_size = IMAGE_GUARD + (size_t)lines * pitch;
    for (int layer = 0; layer < LAYERS(layer_count); ++layer)
        for (int v = top; v <= bottom; ++v) {
            __global float *row = image + layer * layer_size + IMAGE_GUARD + (size_t)v * pitch;
            for (int u = 0; u < pitch; u += LANES)
                V_STORE((vf)(0.0f), row + u);
        }
    const int c_first = line_cells[2 * top], c_stop = line_cells[2 * bottom + 1];
    const tile_list list = list_of(tile_offsets, tile, capacity, count);
    for (int k = 0; k < list.count; ++k) {
        const size_t splat = (size_t)listed_splat(list, tile_splat_ids, k) * cell_count;
        for (int c = c_first; c < c_stop; ++c) {
            if (!is_visible[splat + c])
                continue;
            __global const float *splat_record = records + (splat + c) * RECORD, *cell = cells + c * CELL;
            __global const int *record_as_int = (__global const int *)splat_record;
            painter own = {image + LAYER_AT(cell, lines, pitch), pitch, cutoff2 > 0.0f ? cutoff2 : MAXFLOAT};
            walk_footprint(splat_record, cell, TIMES_OF(c, line_times, time_pitch), time_pitch, path_limits, cutoff2,
                           max(record_as_int[REC_V_LO], top), min(record_as_int[REC_V_HI], bottom), &own);
        }
    }
    for (int layer = 0; layer < LAYERS(layer_count); ++layer)
        for (int v = top; v <= bottom; ++v) {  /* vectors may have written beyond the last pixel, but padding must be zero */
            __global float *row = image + layer * layer_size + IMAGE_GUARD + (size_t)v * pitch;
            for (int u = width; u < pitch; ++u)
                row[u] = 0.0f;
        }
}
#endif
