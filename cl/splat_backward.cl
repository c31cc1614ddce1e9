/* Adjoint of the splat, first pass: a Gaussian walks its own footprint in every time cell and keeps the
   sums that the chain rule needs. Gathers only, no atomics: results repeat bit for bit.
   GROUP work-items share a Gaussian (1 on CPUs, where vectors do the sharing; a small group on GPUs). */
#include "common/splat.h"

#define SUMS 16
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

__kernel void splat_backward(
    __global const float *records,  /* (stride, C, RECORD) */
    __global const float *cells,    /* (C, CELL) */
    __global const float *image,    /* dL/dp: guard, then (lines, pitch), padding zero */
    const int count, const int cell_count, const int pitch, const float cutoff2,
    __global float *sums)           /* (stride, C, SUMS) */
{
#if GROUP > 1
    const int g = (int)get_group_id(0), item = (int)get_local_id(0);
    __local float tree[10 * GROUP];
#else
    const int g = (int)get_global_id(0), item = 0;
#endif
    if (g >= count)
        return;
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int c = 0; c < cell_count; ++c) {
        const size_t at = ((size_t)g * cell_count + c) * RECORD;
        __global const float *rec = records + at;
        __global const int *whole = (__global const int *)rec;
        const int v_lo = whole[REC_V_LO], v_hi = whole[REC_V_HI];
        if (v_hi < v_lo)
            continue;
        const int u_lo = whole[REC_U_LO], u_hi = whole[REC_U_HI];
        vf w_ = (vf)(0.0f), ik_ = w_, uu_ = w_, uv_ = w_, vv_ = w_, u_ = w_, v_ = w_, b_ = w_, bu_ = w_, bv_ = w_;
#if GROUP > 1
        const int span = u_hi - u_lo + 1, pixels = span * (v_hi - v_lo + 1);
        for (int k = item; k < pixels; k += GROUP) {
            const int v = v_lo + k / span, u = u_lo + k % span;
#else
        for (int v = v_lo; v <= v_hi; ++v) {
#endif
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
        }
#if GROUP > 1
        const float mine[10] = {v_sum(w_), v_sum(ik_), v_sum(uu_), v_sum(uv_), v_sum(vv_),
                                v_sum(u_), v_sum(v_), v_sum(b_), v_sum(bu_), v_sum(bv_)};
        for (int f = 0; f < 10; ++f)
            tree[f * GROUP + item] = mine[f];
        for (int reach = GROUP / 2; reach > 0; reach /= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item < reach)
                for (int f = 0; f < 10; ++f)
                    tree[f * GROUP + item] += tree[f * GROUP + item + reach];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int f = item; f < 10; f += GROUP)
            sums[at + f] = tree[f * GROUP];
        barrier(CLK_LOCAL_MEM_FENCE);
#else
        __global float *out = sums + at;
        out[SUM_W] = v_sum(w_);
        out[SUM_IK] = v_sum(ik_);
        out[SUM_UU] = v_sum(uu_);
        out[SUM_UV] = v_sum(uv_);
        out[SUM_VV] = v_sum(vv_);
        out[SUM_U] = v_sum(u_);
        out[SUM_V] = v_sum(v_);
        out[SUM_B] = v_sum(b_);
        out[SUM_BU] = v_sum(bu_);
        out[SUM_BV] = v_sum(bv_);
#endif
    }
}
