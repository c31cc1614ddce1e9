/* Averages intensities over the time cells of a frame, because a detector adds photons, not line integrals.

   The k-th cell of every line is drawn into the k-th layer as w_k p_k. The merged frame M is -ln(sum w_k exp(-p_k)), and
   dM/d(w_k p_k) = exp(-p_k) / sum w_j exp(-p_j), called share. Sums are formed of differences from the smallest p, so that
   nothing overflows and nearly equal p lose no digits. Twin: detector/attenuation.py. */
#include "common/lanes.h"

/* p_k of a pixel, computed from w_k p_k */
#define SEEN(k) (V_LOAD(layers + (size_t)(k) * layer_size + at) * unit / weights[(size_t)(k) * lines + v])

__kernel void intensity_merge(
    __global const float *layers,   /* layer_count images: guard, then (lines, pitch) */
    __global const float *weights,  /* (layer_count, lines): w_k of each line, 0 without a cell */
    const int layer_count, const int lines, const int width, const int pitch,
    const float unit,               /* the line integral that is stored as 1 in the images */
    __global float *shares,         /* layer_count images: dM/d(w_k p_k) */
    __global float *merged)         /* guard, then (lines, pitch), padding is not written */
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1);
    if (u >= width || v >= lines)
        return;
    const size_t at = IMAGE_GUARD + (size_t)v * pitch + u, layer_size = IMAGE_GUARD + (size_t)lines * pitch;
    const vi inside = V_INT((vf)(u) + V_IOTA) < width;
    vf least = (vf)(MAXFLOAT); /* p of the brightest cell */
    for (int k = 0; k < layer_count; ++k)
        if (weights[(size_t)k * lines + v] > 0.0f)
            least = min(least, SEEN(k));
    vf light = (vf)(0.0f); /* sum of w (exp(least - p) - 1) */
    int any = 0;
    for (int k = 0; k < layer_count; ++k) {
        const float weight = weights[(size_t)k * lines + v];
        if (!(weight > 0.0f))
            continue;
        light += weight * expm1(least - SEEN(k));
        any = 1;
    }
    const vf brighter = log1p(max(light, -0.9999999f));
    for (int k = 0; k < layer_count; ++k) {
        vf share = (vf)(0.0f);
        if (weights[(size_t)k * lines + v] > 0.0f)
            share = V_PICK(0.0f, exp(least - SEEN(k) - brighter), inside);
        V_STORE(share, shares + (size_t)k * layer_size + at);
    }
    V_STORE(V_PICK(0.0f, any ? (least - brighter) / unit : (vf)(0.0f), inside), merged + at);
}

/* Writes dL/d(layers) from dL/dM. */
__kernel void intensity_split(
    __global const float *by_merged, /* guard, then (lines, pitch) */
    __global const float *shares,
    const int layer_count, const int lines, const int width, const int pitch,
    __global float *by_layers)
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1);
    if (u >= width || v >= lines)
        return;
    const size_t at = IMAGE_GUARD + (size_t)v * pitch + u, layer_size = IMAGE_GUARD + (size_t)lines * pitch;
    const vf by = V_LOAD(by_merged + at);
    for (int k = 0; k < layer_count; ++k) {
        const size_t there = (size_t)k * layer_size + at;
        V_STORE(by * V_LOAD(shares + there), by_layers + there);
    }
}
