/* Adjoint of splat_forward.cl, first pass: for each Gaussian and time cell, sums over the splat's pixels that the chain rule
   needs (splat_chain.cl). One work-item or work-group sums for a Gaussian, without atomics, so results repeat bit for bit.
   splat_backward_rows: one work-item per Gaussian, with vectors along lines (CPUs).
   splat_backward_group: one work-group per Gaussian, ACROSS items of it along a line (GPUs). */
#if GROUP > 1
#define SPLAT_SPACE __local
#endif
#include "common/footprint.h"
#include "common/group_sums.h"
#include "common/splat_sums.h"

typedef struct { vf of[SUM_COUNT]; } splat_sums;

ALWAYS_INLINE splat_sums no_sums(void)
{
    splat_sums sum;
    for (int f = 0; f < SUM_COUNT; ++f)
        sum.of[f] = (vf)(0.0f);
    return sum;
}

/* Adds the contributions of LANES pixels of a line, from u on. h: dL/d(pixels). */
#if MOVING
ALWAYS_INLINE void gather(splat_sums *sum, const footprint_line line, const int u, const float limit, const vf h)
{
    const vf du = footprint_du(line, u);
    const moving_pixel p = moving_at(line.s, (float)u + V_IOTA, du, limit);
    const moving_means m = moving_all_means(line.s, p, line.speed, line.middle, line.half_time);
    const vf a = V_PICK(0.0f, h, p.drawn) * (line.amp * SQUARE_ROOT(p.d2 * p.rq));
    const vf by_num = -0.5f * a * p.rq;
    sum->of[SUM_W] += a * m.e;
#if AFFINE
    sum->of[SUM_ZZ] += by_num * m.ezz;
    sum->of[SUM_ZC] += by_num * (m.ez * p.across);
    sum->of[SUM_CC] += by_num * (m.e * p.c2);
    sum->of[SUM_Z] += by_num * m.ez;
    sum->of[SUM_C] += by_num * (m.e * p.across);
#else
    const vf along = p.z + line.s.shift;
    const vf by_q = by_num * (m.e - (m.ezz + p.c2 * m.e) * p.rq);
    const vf still = by_q * line.s.inv_kappa; /* Q depends on num at mid-time, not on means over the exposure */
    const vf sb = 2.0f * by_q * p.b;
    sum->of[SUM_IK] += by_q * (along * along + p.c2);
    sum->of[SUM_B] += sb;
    sum->of[SUM_BU] += sb * du;
    sum->of[SUM_BV] += sb * line.dv;
    sum->of[SUM_ZZ] += by_num * m.ezz + still * (along * along);
    sum->of[SUM_ZC] += (by_num * m.ez + still * along) * p.across;
    sum->of[SUM_CC] += (by_num * m.e + still) * p.c2;
    sum->of[SUM_Z] += by_num * m.ez + still * along;
    sum->of[SUM_C] += (by_num * m.e + still) * p.across;
#endif
    sum->of[SUM_TZ] += by_num * m.etz;
    sum->of[SUM_TC] += by_num * (m.et * p.across);
}
#else
ALWAYS_INLINE void gather(splat_sums *sum, const footprint_line line, const int u, const float limit, const vf h)
{
    vf num, b, rq;
    const vf du = footprint_du(line, u);
    const vf value = splat_value(line.s, (float)u + V_IOTA, du, &num, &b, &rq);
    const vf e = num * rq;
    const vf w = V_PICK(0.0f, h * value, e <= limit);
    sum->of[SUM_W] += w;
#if AFFINE
    const vf sn = -0.5f * w;
#else
    const vf by_q = 0.5f * w * rq * (e - 1.0f);
    const vf sn = by_q * line.s.inv_kappa - 0.5f * w * rq;
    const vf sb = 2.0f * by_q * b;
    sum->of[SUM_IK] += by_q * num;
    sum->of[SUM_B] += sb;
    sum->of[SUM_BU] += sb * du;
    sum->of[SUM_BV] += sb * line.dv;
#endif
    const vf su = sn * du;
    sum->of[SUM_U] += su;
    sum->of[SUM_V] += sn * line.dv;
    sum->of[SUM_UU] += su * du;
    sum->of[SUM_UV] += su * line.dv;
    sum->of[SUM_VV] += sn * (line.dv * line.dv);
}
#endif

#if GROUP == 1
typedef struct { splat_sums sums; __global const float *image; int pitch; float limit; } gatherer;

ALWAYS_INLINE void visit(gatherer *own, const footprint_line line)
{
    __global const float *row = own->image + IMAGE_GUARD + (size_t)line.v * own->pitch;
    for (int u = line.u_lo; u <= line.u_hi; u += LANES)
        gather(&own->sums, line, u, own->limit, V_LOAD(row + u));
}

#define VISITOR gatherer
#include "common/footprint_walk.h"
#endif

#define ARGUMENTS                                                                                                    \
    __global float *records,          /* (stride, C, RECORD); the sums replace the records */                       \
    __global const uchar *is_visible, /* (stride, C): 1 where a splat has a record */                                \
    __global const float *cells,      /* (C, CELL): the time cells of the frame */                                   \
    __global const float *line_times, /* MOVING: (C, TIME_ROWS, time_pitch) */                                       \
    const int time_pitch, const float4 path_limits,                                                                  \
    __global const float *images,     /* dL/dp: guard, then (lines, pitch), padding zero; LAYERED: one per layer */    \
    const int count, const int cell_count, const int lines, const int pitch, const float cutoff2

#if GROUP == 1
__kernel void splat_backward_rows(ARGUMENTS)
{
    const int g = (int)get_global_id(0);
    if (g >= count)
        return;
    for (int c = 0; c < cell_count; ++c) {
        const size_t at = (size_t)g * cell_count + c;
        if (!is_visible[at])
            continue;
        __global float *splat_record = records + at * RECORD;
        __global const float *cell = cells + c * CELL;
        __global const int *record_as_int = (__global const int *)splat_record;
        gatherer own = {no_sums(), images + LAYER_AT(cell, lines, pitch), pitch, cutoff2 > 0.0f ? cutoff2 : MAXFLOAT};
        walk_footprint(splat_record, cell, TIMES_OF(c, line_times, time_pitch), time_pitch, path_limits, cutoff2,
                       record_as_int[REC_V_LO], record_as_int[REC_V_HI], &own);
        for (int f = 0; f < SUM_COUNT; ++f)
            splat_record[SUMS + f] = v_sum(own.sums.of[f]);
    }
}
#else
__kernel void splat_backward_group(ARGUMENTS)
{
    const int g = (int)get_global_id(0) / ACROSS, item = GROUP_ITEM; /* a group's id restarts in each part of a launch */
    __local float tree[SUM_COUNT * GROUP], cell[CELL];
    __local int record_as_int[RECORD]; /* as ints: copied as floats, a device may set small ints to 0 */
    __local const float *splat_record = (__local const float *)record_as_int;
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    for (int c = 0; c < cell_count; ++c) {
        const size_t at = (size_t)g * cell_count + c;
        if (!is_visible[at])
            continue;
        for (int f = item; f < RECORD; f += GROUP)
            record_as_int[f] = ((__global const int *)records)[at * RECORD + f];
        for (int f = item; f < CELL; f += GROUP)
            cell[f] = cells[c * CELL + f];
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE); /* waits until all items have read what the sums overwrite */
        __global const float *times = TIMES_OF(c, line_times, time_pitch);
        __global const float *image = images + LAYER_AT(cell, lines, pitch) + IMAGE_GUARD;
        splat_sums mine = no_sums();
        for (int v = record_as_int[REC_V_LO] + (int)get_local_id(1); v <= record_as_int[REC_V_HI]; v += GROUP / ACROSS) {
            const footprint_line line = footprint_within(splat_record, cell, times, time_pitch, v, path_limits, cutoff2);
            for (int u = line.u_lo + (int)get_local_id(0); u <= line.u_hi; u += ACROSS)
                gather(&mine, line, u, limit, image[(size_t)v * pitch + u]);
        }
        group_sums(mine.of, SUM_COUNT, tree, records + at * RECORD + SUMS);
        barrier(CLK_LOCAL_MEM_FENCE); /* waits until all items have read what the next cell overwrites */
    }
}
#endif
