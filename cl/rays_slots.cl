/* Averages slots to frames, and the transpose. A slot is a buffer for the line integrals from one pose, on the part of the
   panel that this pose serves. A frame is an average of slots, with a weight for each line (a detector row if `by_row`,
   else a column). */
#include "common/ray_column.h"

/* A share tells on which lines a slot is part of a frame. Its ints: slot (or frame), lines [first, stop), where the weights
   of these lines begin. */
#define SHARE 4

/* The weights of LANES pixels of column u, from row v on; 0 on lines outside the share. */
RAY_INLINE vf weights_at(__global const float *weights, __global const int *share, const int by_row, const int u, const int v)
{
    const int first = share[1], stop = share[2];
    if (!by_row)
        return (vf)(u >= first && u < stop ? weights[share[3] + u - first] : 0.0f);
    const vi line = VI_IOTA + v;
    const vi place = min(max(line, first), stop - 1) - first;
    __global const float *own = weights + share[3];
    if (v >= first && v + LANES <= stop)
        return V_LOAD(own + v - first);
    return V_PICK(0.0f, GATHER(own, place), (line >= first) & (line < stop));
}

__kernel void merge_slots(
    __global const float *integrals,  /* guard, then (S, columns of a slot, slot_pitch) */
    const int slot_columns, const int slot_pitch,
    __global const int *slots,        /* (S, SLOT): poses, and the lines and columns that they serve */
    __global const int *frame_shares, /* (F + 1,): where each frame's shares begin */
    __global const int *shares,       /* (E, SHARE), frame after frame */
    __global const float *weights,
    const int by_row, const int width, const int height,
    const long4 to,                   /* a pixel is at to.x + u to.y + v to.z + frame to.w */
    __global float *image)
{
    const int u = (int)get_global_id(0), n = (int)get_global_id(1);
    if (u >= width)
        return;
    __global float *pixels = image + to.x + u * to.y + n * to.w;
    for (int v = 0; v < height; v += LANES) {
        vf total = (vf)(0.0f);
        for (int e = frame_shares[n]; e < frame_shares[n + 1]; ++e) {
            __global const int *share = shares + SHARE * e, *slot = slots + SLOT * (size_t)share[0];
            if (by_row && v + LANES <= share[1]) /* shares are sorted by their first line */
                break;
            if (u < slot[SLOT_U] || u >= slot[SLOT_U_STOP] || v + LANES <= slot[SLOT_V] || v >= slot[SLOT_V_STOP])
                continue;
            const vf weight = weights_at(weights, share, by_row, u, v);
            __global const float *column = integrals + IMAGE_GUARD
                + ((size_t)share[0] * slot_columns + u - slot[SLOT_U]) * slot_pitch;
            const int own = v - slot[SLOT_V], most = slot_pitch - LANES;
            /* At the ends of the slot only some lanes are inside. */
            const vf p = own >= 0 && own <= most
                ? V_LOAD(column + own) : GATHER(column, min(max(own + VI_IOTA, 0), slot_pitch - 1));
            total += V_PICK(0.0f, weight * p, weight > 0.0f);
        }
        for (int k = 0; k < min(LANES, height - v); ++k)
            pixels[(v + k) * to.z] = LANE(float, total, k);
    }
}

/* The transpose of merge_slots, times the length of each ray from one plane of voxels to the next. If LEAN, also writes the
   rays' slopes along z, slots_floats after the values. */
__kernel void split_slots(
    __global const float *turned,     /* guard, then (F, width, turned_pitch): frames with detector columns as rows */
    const long start, const int turned_pitch, /* start: floats before the first frame */
    __global const float *cells, __global const int *slots,
    __global const int *slot_shares,  /* (S + 1,): where each slot's shares begin */
    __global const int *shares,       /* (E, SHARE), slot after slot */
    __global const float *weights,
    const int by_row, const int width, const float4 pitch_mm,
    const int slot_columns, const int slot_pitch, const long slots_floats,
    __global float *values)           /* guard, then (S, slot_columns, slot_pitch) */
{
    const int n = (int)get_global_id(1);
    __global const int *slot = slots + SLOT * (size_t)n;
    const int u = slot[SLOT_U] + (int)get_global_id(0);
    if (u >= slot[SLOT_U_STOP])
        return;
    __global const float *cell = cells + (size_t)slot[SLOT_CELL] * RAY_CELL;
    __global float *column = values + IMAGE_GUARD + ((size_t)n * slot_columns + u - slot[SLOT_U]) * slot_pitch;
    for (int own = 0; own < slot_pitch; own += LANES) {
        const int v = slot[SLOT_V] + own;
        const column_rays_t d = column_rays(cell, u, v);
        vf sum = (vf)(0.0f);
        for (int e = slot_shares[n]; e < slot_shares[n + 1]; ++e) {
            __global const int *share = shares + SHARE * e;
            __global const float *pixels = turned + IMAGE_GUARD + start + ((size_t)share[0] * width + u) * turned_pitch;
            if (v >= slot[SLOT_V_STOP])
                continue;
            const vf y = v + LANES <= turned_pitch ? V_LOAD(pixels + v) : GATHER(pixels, min(v + VI_IOTA, turned_pitch - 1));
            sum += weights_at(weights, share, by_row, u, v) * y;
        }
        const vi inside = (VI_IOTA + v) < slot[SLOT_V_STOP];
        V_STORE(V_PICK(0.0f, sum * column_steps_mm(cell, d, pitch_mm), inside), column + own);
#if LEAN
        V_STORE(d.z / V_PICK(d.y, d.x, column_along_x(cell, d) == 1), column + slots_floats + own);
#endif
    }
}
