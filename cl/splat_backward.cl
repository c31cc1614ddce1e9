/* Adjoint of the splat, first pass: a Gaussian walks its own footprint in every time cell and keeps the
   sums that the chain rule needs. Gathers only, no atomics: results repeat bit for bit.
   GROUP work-items share a Gaussian (1 on CPUs, where vectors do the sharing; a small group on GPUs). */
#include "common/splat_moving.h"

#define SUMS 16
#if MOVING
#define SUM_COUNT 12 /* in the coordinates of common/splat_moving.h, where nothing cancels */
#define SUM_W 0
#define SUM_IK 1
#define SUM_ZZ 2     /* by the squares and the product of z and across */
#define SUM_ZC 3
#define SUM_CC 4
#define SUM_Z 5      /* for the centre through num */
#define SUM_C 6
#define SUM_B 7
#define SUM_BU 8
#define SUM_BV 9
#define SUM_TZ 10    /* for the path through num */
#define SUM_TC 11
#else
#define SUM_COUNT 10
#define SUM_W 0      /* sum of gradient x value: the derivative by log amplitude */
#define SUM_IK 1     /* by 1/kappa */
#define SUM_UU 2     /* by S11, S12 (once), S22 without their factors */
#define SUM_UV 3
#define SUM_VV 4
#define SUM_U 5      /* for the centre through num */
#define SUM_V 6
#define SUM_B 7      /* by B = 1 + b.D, and its moments */
#define SUM_BU 8
#define SUM_BV 9
#endif

#if MOVING
typedef struct { vf of[SUM_COUNT]; } moving_sums;

/* adds what the pixels u.. of a line contribute; h: gradient by the pixels */
ALWAYS_INLINE void moving_gather(moving_sums *sum, const moving_line s, const float amp, const float speed,
                                 const float middle, const float half_time, const float dv, const vf u, const vf du,
                                 const float limit, const vf h)
{
    const moving_pixel p = moving_at(s, u, du, limit);
    const moving_means m = moving_all_means(s, p, speed, middle, half_time);
    const vf a = V_PICK(0.0f, h, p.drawn) * (amp * SQUARE_ROOT(p.d2 * p.rq));
    const vf by_num = -0.5f * a * p.rq;
    sum->of[SUM_W] += a * m.e;
#if AFFINE
    sum->of[SUM_ZZ] += by_num * m.ezz;
    sum->of[SUM_ZC] += by_num * (m.ez * p.across);
    sum->of[SUM_CC] += by_num * (m.e * p.c2);
    sum->of[SUM_Z] += by_num * m.ez;
    sum->of[SUM_C] += by_num * (m.e * p.across);
#else
    const vf along = p.z + s.shift;
    const vf by_q = by_num * (m.e - (m.ezz + p.c2 * m.e) * p.rq);
    const vf still = by_q * s.inv_kappa; /* Q has num at mid-time */
    const vf sb = 2.0f * by_q * p.b;
    sum->of[SUM_IK] += by_q * (along * along + p.c2);
    sum->of[SUM_B] += sb;
    sum->of[SUM_BU] += sb * du;
    sum->of[SUM_BV] += sb * dv;
    sum->of[SUM_ZZ] += by_num * m.ezz + still * (along * along);
    sum->of[SUM_ZC] += (by_num * m.ez + still * along) * p.across;
    sum->of[SUM_CC] += (by_num * m.e + still) * p.c2;
    sum->of[SUM_Z] += by_num * m.ez + still * along;
    sum->of[SUM_C] += (by_num * m.e + still) * p.across;
#endif
    sum->of[SUM_TZ] += by_num * m.etz;
    sum->of[SUM_TC] += by_num * (m.et * p.across);
}
#endif

__kernel void splat_backward(
    __global const float *records,  /* (stride, C, RECORD) */
    __global const uchar *seen,     /* (stride, C) */
    __global const float *cells,    /* (C, CELL) */
    __global const float *line_times, /* MOVING: (C, TIME_ROWS, time_pitch) */
    const int time_pitch, const float4 path_limits,
    __global const float *images,   /* dL/dp: guard, then (lines, pitch), padding zero; LAYERED: one a layer */
    const int count, const int cell_count, const int lines, const int pitch, const float cutoff2,
    __global float *sums)           /* (stride, C, SUMS) */
{
#if GROUP > 1
    const int g = (int)get_group_id(0), item = (int)get_local_id(0);
    __local float tree[SUM_COUNT * GROUP];
#else
    const int g = (int)get_global_id(0), item = 0;
#endif
    if (g >= count)
        return;
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int c = 0; c < cell_count; ++c) {
        const size_t at = (size_t)g * cell_count + c;
        if (!seen[at])
            continue;
        __global const float *rec = records + at * RECORD;
        __global const int *whole = (__global const int *)rec;
        const int v_lo = whole[REC_V_LO], v_hi = whole[REC_V_HI];
        const int u_lo = whole[REC_U_LO], u_hi = whole[REC_U_HI];
        __global const float *image = images + LAYER_AT(cells + c * CELL, lines, pitch);
#if MOVING
        __global const float *times = line_times + (size_t)c * TIME_ROWS * time_pitch;
        const float speed = rec[REC_SPEED];
        moving_sums sum;
        for (int f = 0; f < SUM_COUNT; ++f)
            sum.of[f] = (vf)(0.0f);
#else
        vf w_ = (vf)(0.0f), ik_ = w_, uu_ = w_, uv_ = w_, vv_ = w_, u_ = w_, v_ = w_, b_ = w_, bu_ = w_, bv_ = w_;
#endif
#if GROUP > 1
        const int span = u_hi - u_lo + 1, pixels = span * (v_hi - v_lo + 1);
        for (int k = item; k < pixels; k += GROUP) {
            const int v = v_lo + k / span, u = u_lo + k % span;
#if MOVING
            const float weight = times[TIME_WEIGHT * time_pitch + v];
            if (weight <= 0.0f)
                continue;
            const float middle = times[v], half_time = times[TIME_HALF * time_pitch + v];
            const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
            const float du = (float)(u - whole[REC_U_WHOLE]) - rec[REC_U_REST];
            const moving_line s = moving_on_line(rec, cells + c * CELL, (float)v, dv, middle, half_time, weight,
                                                 path_limits);
            moving_gather(&sum, s, rec[REC_AMP] * weight, speed, middle, half_time, dv, (float)u, du, limit,
                          image[IMAGE_GUARD + (size_t)v * pitch + u]);
#endif
#elif MOVING
        for (int first = v_lo; first <= v_hi; first += LANES) {
            const vf dvs = ((float)(first - whole[REC_V_WHOLE]) + V_IOTA) - rec[REC_V_REST];
            const vf middles = V_LOAD(times + first), halves = V_LOAD(times + TIME_HALF * time_pitch + first);
            const vf weights = V_LOAD(times + TIME_WEIGHT * time_pitch + first);
            vi lo, hi;
            moving_span(rec, dvs, middles, halves, weights, cutoff2 > 0.0f, &lo, &hi);
            for (int lane = 0; lane < min(LANES, v_hi - first + 1); ++lane) {
                const int u_from = LANE(int, lo, lane), u_to = LANE(int, hi, lane), v = first + lane;
                if (u_to < u_from)
                    continue;
                const float dv = LANE(float, dvs, lane), middle = LANE(float, middles, lane);
                const float half_time = LANE(float, halves, lane), weight = LANE(float, weights, lane);
                const moving_line s = moving_on_line(rec, cells + c * CELL, (float)v, dv, middle, half_time, weight,
                                                     path_limits);
                __global const float *row = image + IMAGE_GUARD + (size_t)v * pitch;
                for (int u = u_from; u <= u_to; u += LANES) {
                    const vf du = ((float)(u - whole[REC_U_WHOLE]) + V_IOTA) - rec[REC_U_REST];
                    moving_gather(&sum, s, rec[REC_AMP] * weight, speed, middle, half_time, dv, (float)u + V_IOTA, du,
                                  limit, V_LOAD(row + u));
                }
            }
#else
        for (int v = v_lo; v <= v_hi; ++v) {
#endif
#if !MOVING
            const float dv = (float)(v - whole[REC_V_WHOLE]) - rec[REC_V_REST];
            const splat_line s = splat_on_line(rec, cells + c * CELL, (float)v, dv);
            __global const float *row = image + IMAGE_GUARD + (size_t)v * pitch;
#if GROUP == 1
            for (int u = u_lo; u <= u_hi; u += LANES)
#endif
            {
                vf num, b, rq;
                const vf uu = (float)u + V_IOTA;
                const vf du = ((float)(u - whole[REC_U_WHOLE]) + V_IOTA) - rec[REC_U_REST];
                const vf value = splat_value(s, uu, du, &num, &b, &rq);
                const vf e = num * rq;
                const vf w = V_PICK(0.0f, V_LOAD(row + u) * value, e <= limit);
                w_ += w;
#if AFFINE
                const vf sn = -0.5f * w;
#else
                const vf by_q = 0.5f * w * rq * (e - 1.0f);
                const vf sn = by_q * s.inv_kappa - 0.5f * w * rq;
                const vf sb = 2.0f * by_q * b;
                ik_ += by_q * num;
                b_ += sb;
                bu_ += sb * du;
                bv_ += sb * dv;
#endif
                const vf su = sn * du;
                u_ += su;
                v_ += sn * dv;
                uu_ += su * du;
                uv_ += su * dv;
                vv_ += sn * (dv * dv);
            }
#endif
        }
#if MOVING
        float mine[SUM_COUNT];
        for (int f = 0; f < SUM_COUNT; ++f)
            mine[f] = v_sum(sum.of[f]);
#else
        const float mine[SUM_COUNT] = {v_sum(w_), v_sum(ik_), v_sum(uu_), v_sum(uv_), v_sum(vv_),
                                v_sum(u_), v_sum(v_), v_sum(b_), v_sum(bu_), v_sum(bv_)};
#endif
#if GROUP > 1
        for (int f = 0; f < SUM_COUNT; ++f)
            tree[f * GROUP + item] = mine[f];
        for (int reach = GROUP / 2; reach > 0; reach /= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item < reach)
                for (int f = 0; f < SUM_COUNT; ++f)
                    tree[f * GROUP + item] += tree[f * GROUP + item + reach];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int f = item; f < SUM_COUNT; f += GROUP)
            sums[at * SUMS + f] = tree[f * GROUP];
        barrier(CLK_LOCAL_MEM_FENCE);
#else
        for (int f = 0; f < SUM_COUNT; ++f)
            sums[at * SUMS + f] = mine[f];
#endif
    }
}
