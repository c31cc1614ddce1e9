/* Micro-view accumulation and strip concatenation (paper, Eq. 3) in one gather: every tile of the merged
   frame sums its list of splats over all time cells that serve its lines.
   A work-item owns BLOCK_W x BLOCK_H pixels: a band of whole lines on CPUs, where it walks vectors of
   pixels; one pixel on GPUs, where a work-group is a tile. Nobody else writes those pixels: no atomics. */
#include "common/splat.h"

__kernel void splat_forward(
    __global const float *records,   /* (stride, C, RECORD) */
    __global const float *cells,     /* (C, CELL) */
    __global const int *line_cells,  /* (lines, 2): first cell and cell after the last that serve a line */
    __global const int *starts,      /* (tiles + 1,) */
    __global const int *entries,
    const int cell_count,
    const int lines, const int width, const int pitch,
    const int tile_w, const int tile_h, const int tiles_u,
    const float cutoff2,
    __global float *image)           /* guard, then (lines, pitch) */
{
#if BLOCK_PIXEL
    const int u = (int)get_global_id(0), v = (int)get_global_id(1);
    if (u >= pitch || v >= lines)
        return;
    const size_t at = IMAGE_GUARD + (size_t)v * pitch + u;
    if (u >= width) {
        image[at] = 0.0f;
        return;
    }
    const int tile = (v / tile_h) * tiles_u + u / tile_w;
    const int c_first = line_cells[2 * v], c_stop = line_cells[2 * v + 1];
    float sum = 0.0f;
    for (int e = starts[tile]; e < starts[tile + 1]; ++e) {
        __global const float *own = records + (size_t)entries[e] * cell_count * RECORD;
        for (int c = c_first; c < c_stop; ++c) {
            __global const float *rec = own + c * RECORD;
            __global const int *whole = (__global const int *)rec;
            if (v < whole[REC_V_LO] || v > whole[REC_V_HI] || u < whole[REC_U_LO] || u > whole[REC_U_HI])
                continue;
            const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
            const splat_line s = splat_on_line(rec, cells + c * CELL, (float)v, dv);
            float num, b, rq;
            const float du = (float)(u - whole[REC_U_WHOLE]) - rec[REC_U_REST];
            const float value = splat_value(s, (float)u, du, &num, &b, &rq);
            sum += (cutoff2 <= 0.0f || num * rq <= cutoff2) ? value : 0.0f;
        }
    }
    image[at] = sum;
#else
    const int tile = (int)get_global_id(0);
    const int top = tile * tile_h;
    if (top >= lines)
        return;
    const int bottom = min(top + tile_h, lines) - 1;
    for (int v = top; v <= bottom; ++v) {
        __global float *row = image + IMAGE_GUARD + (size_t)v * pitch;
        for (int u = 0; u < pitch; u += LANES)
            V_STORE((vf)(0.0f), row + u);
    }
    const int c_first = line_cells[2 * top], c_stop = line_cells[2 * bottom + 1];
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int e = starts[tile]; e < starts[tile + 1]; ++e) {
        __global const float *own = records + (size_t)entries[e] * cell_count * RECORD;
        for (int c = c_first; c < c_stop; ++c) {
            __global const float *rec = own + c * RECORD;
            __global const int *whole = (__global const int *)rec;
            const int v_lo = max(whole[REC_V_LO], top), v_hi = min(whole[REC_V_HI], bottom);
            for (int v = v_lo; v <= v_hi; ++v) {
                const int u_lo = whole[REC_U_LO], u_hi = whole[REC_U_HI];
                const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
                const splat_line s = splat_on_line(rec, cells + c * CELL, (float)v, dv);
                __global float *row = image + IMAGE_GUARD + (size_t)v * pitch;
                for (int u = u_lo; u <= u_hi; u += LANES) {
                    vf num, b, rq;
                    const vf uu = (float)u + V_IOTA;
                    const vf du = ((float)(u - whole[REC_U_WHOLE]) + V_IOTA) - rec[REC_U_REST];
                    const vf value = splat_value(s, uu, du, &num, &b, &rq);
                    V_STORE(V_LOAD(row + u) + V_PICK(0.0f, value, num * rq <= limit), row + u);
                }
            }
        }
    }
    for (int v = top; v <= bottom; ++v) {  /* vectors may have run past the last pixel: padding stays zero */
        __global float *row = image + IMAGE_GUARD + (size_t)v * pitch;
        for (int u = width; u < pitch; ++u)
            row[u] = 0.0f;
    }
#endif
}
