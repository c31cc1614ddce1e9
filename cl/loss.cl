/* The loss of one frame, from L1 and 1 - SSIM, and its gradient. SSIM's window is separable: a pass along rows, then
   columns. Images are guard floats, then (lines, pitch), with pitch at least width + guard. All after the width is zero, so
   a window may reach beyond either end. On a CPU a work-item takes all vectors of a line, on a GPU one pixel. Twin:
   objective/terms.py. */
#include "common/lanes.h"
#include "common/group_sums.h"

#define RADIUS 5

static inline vf masked(__global const float *image, __global const float *mask, const size_t at)
{
    return V_LOAD(image + at) * V_LOAD(mask + at);
}

/* Pass along rows: weighted means of x, y, xx, yy and xy over the window. x is the rendered and y the measured image, both 0
   where the mask is 0. */
__kernel void ssim_moments(
    __global const float *rendered, __global const float *measured, __global const float *mask,
    __constant float *window, const int lines, const int width, const int pitch,
    __global float *moments)         /* 5 images */
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1);
    if (u >= width || v >= lines)
        return;
    const size_t row = IMAGE_GUARD + (size_t)v * pitch + u, image = IMAGE_GUARD + (size_t)lines * pitch;
    vf x = (vf)(0.0f), y = x, xx = x, yy = x, xy = x;
    for (int k = -RADIUS; k <= RADIUS; ++k) {
        const float w = window[k + RADIUS];
        const vf a = masked(rendered, mask, row + k), b = masked(measured, mask, row + k);
        const vf wa = w * a, wb = w * b;
        x += wa;
        y += wb;
        xx += wa * a;
        yy += wb * b;
        xy += wa * b;
    }
    V_STORE(x, moments + row);
    V_STORE(y, moments + image + row);
    V_STORE(xx, moments + 2 * image + row);
    V_STORE(yy, moments + 3 * image + row);
    V_STORE(xy, moments + 4 * image + row);
}

/* Pass along columns, which completes the means. Writes SSIM's derivatives by mean(x), mean(xx) and mean(xy), and the sums
   over a work-group's pixels. */
__kernel void ssim_map(
    __global const float *moments, __global const float *rendered, __global const float *measured,
    __global const float *mask, __constant float *window,
    const int lines, const int width, const int pitch, const float c1, const float c2,
    __global float *partials,        /* 3 images */
    __local float *tree,             /* scratch for three sums: (3, group's items) */
    __global float *sums)            /* (groups, 3): sums of SSIM, mask · |x - y| and mask */
{
    const int v = (int)get_global_id(1), stop = v < lines ? width : 0;
    const size_t image = IMAGE_GUARD + (size_t)lines * pitch;
    vf ssim_sum = (vf)(0.0f), l1_sum = ssim_sum, pixels = ssim_sum;
    for (int u = (int)get_global_id(0) * LANES; u < stop; u += (int)get_global_size(0) * LANES) {
        const size_t at = IMAGE_GUARD + (size_t)v * pitch + u;
        vf m[5] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
        for (int k = max(-RADIUS, -v); k <= min(RADIUS, lines - 1 - v); ++k) {
            const float w = window[k + RADIUS];
            const size_t there = at + (long)k * pitch;
            for (int f = 0; f < 5; ++f)
                m[f] += w * V_LOAD(moments + f * image + there);
        }
        const vi inside = V_INT((vf)(u) + V_IOTA) < width;
        const vf xx = m[2] - m[0] * m[0], yy = m[3] - m[1] * m[1], xy = m[4] - m[0] * m[1];
        const vf n1 = 2.0f * m[0] * m[1] + c1, n2 = 2.0f * xy + c2;
        const vf d1 = m[0] * m[0] + m[1] * m[1] + c1, d2 = xx + yy + c2;
        const vf inv = 1.0f / (d1 * d2);
        const vf ssim = n1 * n2 * inv;
        const vf by_xx = -ssim / d2, by_xy = 2.0f * n1 * inv;
        const vf by_x = 2.0f * (m[1] * n2 * inv - m[0] * ssim / d1) - 2.0f * m[0] * by_xx - m[1] * by_xy;
        V_STORE(V_PICK(0.0f, by_x, inside), partials + at);
        V_STORE(V_PICK(0.0f, by_xx, inside), partials + image + at);
        V_STORE(V_PICK(0.0f, by_xy, inside), partials + 2 * image + at);
        const vf weight = V_LOAD(mask + at);
        ssim_sum += V_PICK(0.0f, ssim, inside);
        l1_sum += weight * fabs(V_LOAD(rendered + at) - V_LOAD(measured + at));
        pixels += weight;
    }
    const float own[3] = {v_sum(ssim_sum), v_sum(l1_sum), v_sum(pixels)};
    group_sums(own, 3, tree, sums + 3 * (get_group_id(1) * get_num_groups(0) + get_group_id(0)));
}

/* Applies the window along rows to the three derivative images. */
__kernel void ssim_spread(
    __global const float *partials, __constant float *window, const int lines, const int width, const int pitch,
    __global float *spread)          /* 3 images */
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1);
    if (u >= width || v >= lines)
        return;
    const size_t row = IMAGE_GUARD + (size_t)v * pitch + u, image = IMAGE_GUARD + (size_t)lines * pitch;
    for (int f = 0; f < 3; ++f) {
        vf sum = (vf)(0.0f);
        for (int k = -RADIUS; k <= RADIUS; ++k)
            sum += window[k + RADIUS] * V_LOAD(partials + f * image + row + k);
        V_STORE(sum, spread + f * image + row);
    }
}

/* Applies the window along columns, and writes the gradient mask (l1_weight sign(x - y) - ssim_weight dSSIM/dx). */
__kernel void image_gradient(
    __global const float *spread, __global const float *rendered, __global const float *measured,
    __global const float *mask, __constant float *window,
    const int lines, const int width, const int pitch, const float l1_weight, const float ssim_weight,
    __global float *gradient)        /* guard, then (lines, pitch) */
{
    const int v = (int)get_global_id(1);
    if (v >= lines)
        return;
    const size_t image = IMAGE_GUARD + (size_t)lines * pitch;
    for (int u = (int)get_global_id(0) * LANES; u < pitch; u += (int)get_global_size(0) * LANES) {
        const size_t at = IMAGE_GUARD + (size_t)v * pitch + u;
        if (u >= width) {
            V_STORE((vf)(0.0f), gradient + at);
            continue;
        }
        vf m[3] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
        if (ssim_weight != 0.0f)
            for (int k = max(-RADIUS, -v); k <= min(RADIUS, lines - 1 - v); ++k)
                for (int f = 0; f < 3; ++f)
                    m[f] += window[k + RADIUS] * V_LOAD(spread + f * image + at + (long)k * pitch);
        const vf weight = V_LOAD(mask + at);
        const vf x = V_LOAD(rendered + at), y = V_LOAD(measured + at);
        const vf by_ssim = m[0] + 2.0f * weight * x * m[1] + weight * y * m[2];
        const vf difference = x - y;
        const vf by_l1 = V_PICK(V_PICK(0.0f, -l1_weight, difference < 0.0f), l1_weight, difference > 0.0f);
        V_STORE(weight * (by_l1 - ssim_weight * by_ssim), gradient + at);
    }
}
