/* Micro-view accumulation and strip concatenation (paper, Eq. 3) in one gather: every tile of the merged
   frame sums its list of splats over all time cells that serve its lines.
   A work-item owns BLOCK_W x BLOCK_H pixels: a band of whole lines on CPUs, where it walks vectors of
   pixels; one pixel on GPUs, where a work-group is a tile. Nobody else writes those pixels: no atomics. */
#include "common/splat_moving.h"

#if MOVING && !BLOCK_PIXEL
/* adds a splat to the pixels u_lo..u_hi of a line; one loop a rule, so that nothing is asked a pixel */
#define ADD_PIXELS(rule)                                                                       \
    for (int u = u_lo; u <= u_hi; u += LANES) {                                                \
        const vf du = ((float)(u - u_whole) + V_IOTA) - u_rest;                                \
        const moving_pixel p = moving_at(s, (float)u + V_IOTA, du, limit);                     \
        V_STORE(V_LOAD(row + u) + V_PICK(0.0f, moving_value(rule, s, p), p.drawn), row + u);   \
    }

ALWAYS_INLINE void moving_add_line(const moving_line s, const int u_lo, const int u_hi, const int u_whole,
                                   const float u_rest, const float limit, __global float *row)
{
    if (s.rule == CLOSED)
        ADD_PIXELS(CLOSED)
    else if (s.rule == 1)
        ADD_PIXELS(1)
    else if (s.rule == 2)
        ADD_PIXELS(2)
    else
        ADD_PIXELS(3)
}

ALWAYS_INLINE void moving_rows(__global const float *rec, __global const float *cell, __global const float *times,
                               const int time_pitch, const int v_lo, const int v_hi, const float4 path_limits,
                               const float cutoff2, __global float *image, const int pitch)
{
    __global const int *whole = (__global const int *)rec;
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int first = v_lo; first <= v_hi; first += LANES) {
        const vf dvs = ((float)(first - whole[REC_V_WHOLE]) + V_IOTA) - rec[REC_V_REST];
        const vf middle = V_LOAD(times + first), half_time = V_LOAD(times + TIME_HALF * time_pitch + first);
        const vf weight = V_LOAD(times + TIME_WEIGHT * time_pitch + first);
        vi lo, hi;
        moving_span(rec, dvs, middle, half_time, weight, cutoff2 > 0.0f, &lo, &hi);
        for (int lane = 0; lane < min(LANES, v_hi - first + 1); ++lane) {
            const int u_lo = LANE(int, lo, lane), u_hi = LANE(int, hi, lane), v = first + lane;
            if (u_hi < u_lo)
                continue;
            const moving_line s = moving_on_line(rec, cell, (float)v, LANE(float, dvs, lane), LANE(float, middle, lane),
                                                 LANE(float, half_time, lane), LANE(float, weight, lane), path_limits);
            moving_add_line(s, u_lo, u_hi, whole[REC_U_WHOLE], rec[REC_U_REST], limit,
                            image + IMAGE_GUARD + (size_t)v * pitch);
        }
    }
}
#endif

__kernel void splat_forward(
    __global const float *records,   /* (stride, C, RECORD) */
    __global const uchar *seen,      /* (stride, C) */
    __global const float *cells,     /* (C, CELL) */
    __global const int *line_cells,  /* (lines, 2): first cell and cell after the last that serve a line */
    __global const float *line_times, /* MOVING: (C, TIME_ROWS, time_pitch) */
    const int time_pitch,
    const float4 path_limits,        /* MOVING: the longest paths, in widths, that 1, 2 and 3 times serve */
    __global const int *starts,      /* (tiles + 1,) */
    __global const int *entries,
    const int cell_count,
    const int lines, const int width, const int pitch,
    const int tile_w, const int tile_h, const int tiles_u,
    const float cutoff2,
    const int layer_count,           /* LAYERED: images, each of guard and (lines, pitch); else one of all cells */
    __global float *image)           /* guard, then (lines, pitch) */
{
#if BLOCK_PIXEL
    const int u = (int)get_global_id(0), v = (int)get_global_id(1);
    if (u >= pitch || v >= lines)
        return;
    const size_t at = IMAGE_GUARD + (size_t)v * pitch + u;
    const size_t layer_size = IMAGE_GUARD + (size_t)lines * pitch;
    for (int layer = 0; layer < LAYERS(layer_count); ++layer)
        image[layer * layer_size + at] = 0.0f;
    if (u >= width)
        return;
    const int tile = (v / tile_h) * tiles_u + u / tile_w;
    const int c_first = line_cells[2 * v], c_stop = line_cells[2 * v + 1];
    float sum = 0.0f;
    for (int e = starts[tile]; e < starts[tile + 1]; ++e) {
        const size_t own = (size_t)entries[e] * cell_count;
        for (int c = c_first; c < c_stop; ++c) {
            if (!seen[own + c])
                continue;
            __global const float *rec = records + (own + c) * RECORD;
            __global const int *whole = (__global const int *)rec;
            if (v < whole[REC_V_LO] || v > whole[REC_V_HI] || u < whole[REC_U_LO] || u > whole[REC_U_HI])
                continue;
            const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
            const float du = (float)(u - whole[REC_U_WHOLE]) - rec[REC_U_REST];
#if MOVING
            __global const float *t = line_times + (size_t)c * TIME_ROWS * time_pitch + v;
            const moving_line s = moving_on_line(rec, cells + c * CELL, (float)v, dv, t[0], t[TIME_HALF * time_pitch],
                                                 t[TIME_WEIGHT * time_pitch], path_limits);
            const moving_pixel p = moving_at(s, (float)u, du, cutoff2 > 0.0f ? cutoff2 : MAXFLOAT);
            const float value = p.drawn ? moving_value(s.rule, s, p) : 0.0f;
#else
            const splat_line s = splat_on_line(rec, cells + c * CELL, (float)v, dv);
            float num, b, rq;
            const float all = splat_value(s, (float)u, du, &num, &b, &rq);
            const float value = (cutoff2 <= 0.0f || num * rq <= cutoff2) ? all : 0.0f;
#endif
#if LAYERED
            image[LAYER_AT(cells + c * CELL, lines, pitch) + at] += value; /* nobody else's pixel */
#else
            sum += value;
#endif
        }
    }
#if !LAYERED
    image[at] = sum;
#endif
#else
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
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int e = starts[tile]; e < starts[tile + 1]; ++e) {
        const size_t own = (size_t)entries[e] * cell_count;
        for (int c = c_first; c < c_stop; ++c) {
            if (!seen[own + c])
                continue;
            __global const float *rec = records + (own + c) * RECORD;
            __global const int *whole = (__global const int *)rec;
            const int v_lo = max(whole[REC_V_LO], top), v_hi = min(whole[REC_V_HI], bottom);
            __global float *own_image = image + LAYER_AT(cells + c * CELL, lines, pitch);
#if MOVING
            moving_rows(rec, cells + c * CELL, line_times + (size_t)c * TIME_ROWS * time_pitch, time_pitch,
                        v_lo, v_hi, path_limits, cutoff2, own_image, pitch);
#else
            for (int v = v_lo; v <= v_hi; ++v) {
                const int u_lo = whole[REC_U_LO], u_hi = whole[REC_U_HI];
                const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
                const splat_line s = splat_on_line(rec, cells + c * CELL, (float)v, dv);
                __global float *row = own_image + IMAGE_GUARD + (size_t)v * pitch;
                for (int u = u_lo; u <= u_hi; u += LANES) {
                    vf num, b, rq;
                    const vf uu = (float)u + V_IOTA;
                    const vf du = ((float)(u - whole[REC_U_WHOLE]) + V_IOTA) - rec[REC_U_REST];
                    const vf value = splat_value(s, uu, du, &num, &b, &rq);
                    V_STORE(V_LOAD(row + u) + V_PICK(0.0f, value, num * rq <= limit), row + u);
                }
            }
#endif
        }
    }
    for (int layer = 0; layer < LAYERS(layer_count); ++layer)
        for (int v = top; v <= bottom; ++v) {  /* vectors may have run past the last pixel: padding stays zero */
            __global float *row = image + layer * layer_size + IMAGE_GUARD + (size_t)v * pitch;
            for (int u = width; u < pitch; ++u)
                row[u] = 0.0f;
        }
#endif
}
