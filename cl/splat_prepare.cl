/* Multi-pose preparation: every Gaussian seen from every time cell of a frame, in one launch.
   A work-item takes LANES Gaussians and walks the cells. Twin: operators/twins/splat.py. */
#include "common/precise.h"
#include "common/gaussian.h"
#include "common/splat.h"

__kernel void splat_prepare(
    __global const float *gaussians,      /* (11, stride) */
    __global const float *cells,          /* (C, CELL) */
    __global const coefficient *matrices, /* (C, 12): rows give u z, v z and z of a world point */
    __global const int *cell_lines,       /* (C, 2): first line, line after the last */
    const int cell_count,
    const int count,
    const int stride,
    const int width,                      /* pixels across the lines */
    const float cutoff2,                  /* squared Mahalanobis radius; 0 = no cutoff */
    __global float *records,              /* (stride, C, RECORD) */
    __global int *extents)                /* (6, stride): u lo hi, v lo hi, 0 0 over all cells */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    __global const float *g = gaussians + first;
    const v3 mean = v3_make(V_LOAD(g), V_LOAD(g + stride), V_LOAD(g + 2 * stride));
    const v3 scale = v3_make(V_LOAD(g + 3 * stride), V_LOAD(g + 4 * stride), V_LOAD(g + 5 * stride));
    const frame3 axes = quaternion_frame(V_LOAD(g + 6 * stride), V_LOAD(g + 7 * stride),
                                         V_LOAD(g + 8 * stride), V_LOAD(g + 9 * stride));
    const vf density = V_LOAD(g + 10 * stride);
    const v3 inv_scale = v3_make(1.0f / scale.x, 1.0f / scale.y, 1.0f / scale.z);
    const vf inv_det = inv_scale.x * inv_scale.y * inv_scale.z;
    const vi exists = V_INT((vf)(first) + V_IOTA) < count;

    vi u_min = (vi)(0x7fffffff), v_min = u_min;
    vi u_max = (vi)(-1), v_max = u_max;

    for (int c = 0; c < cell_count; ++c) {
        __global const float *cell = cells + c * CELL;
        __global const coefficient *m = matrices + c * 12;
        const int line_first = cell_lines[2 * c], line_last = cell_lines[2 * c + 1] - 1;
        vf u_rest, v_rest;
        const vwide depth = wide_dot(m + 8, mean.x, mean.y, mean.z);
        const vf u_whole = wide_ratio(wide_dot(m, mean.x, mean.y, mean.z), depth, &u_rest);
        const vf v_whole = wide_ratio(wide_dot(m + 4, mean.x, mean.y, mean.z), depth, &v_rest);
        const vf z = wide_value(depth);

        const v3 ray = to_local(axes, v3_make(mean.x - cell[CELL_SOURCE], mean.y - cell[CELL_SOURCE + 1],
                                              mean.z - cell[CELL_SOURCE + 2]));
        const v3 eu = to_local(axes, v3_make((vf)(cell[CELL_EU]), (vf)(cell[CELL_EU + 1]), (vf)(cell[CELL_EU + 2])));
        const v3 ev = to_local(axes, v3_make((vf)(cell[CELL_EV]), (vf)(cell[CELL_EV + 1]), (vf)(cell[CELL_EV + 2])));
        const v3 white = v3_mul(ray, inv_scale);
        const vf kappa = v3_dot(white, white);
        const vf inv_kappa = 1.0f / kappa;
        const vf root = rsqrt(kappa);

        /* Gram form of S: no difference of large numbers, so needles keep their digits */
        const v3 gu = v3_scale(v3_mul(scale, v3_cross(ray, eu)), inv_det);
        const v3 gv = v3_scale(v3_mul(scale, v3_cross(ray, ev)), inv_det);
        const vf gu_length = sqrt(v3_dot(gu, gu));
        const vf factor = z * root;
        const vf l11 = gu_length * factor;
        const vf l12 = v3_dot(gu, gv) / gu_length * factor;
        const vf l22 = z * z * z * fabs((vf)(cell[CELL_VOLUME])) * inv_det * root / l11;
#if AFFINE
        const vf b1 = (vf)(0.0f), b2 = (vf)(0.0f), ik = (vf)(0.0f);
        const vf ray_length = sqrt(v3_dot(ray, ray)) / z;
#else
        const vf b1 = z * inv_kappa * v3_dot(white, v3_mul(eu, inv_scale));
        const vf b2 = z * inv_kappa * v3_dot(white, v3_mul(ev, inv_scale));
        const vf ik = inv_kappa;
        const vf ray_length = (vf)(1.0f);
#endif
        const vf amp = cell[CELL_WEIGHT] * 2.50662827463f * density * factor * ray_length;

        /* the ellipse q <= cutoff2 is D'TD - 2 c b.D - c <= 0 with T = S (1 - c/kappa) - c b b' */
        vi drawn = exists & (z > 0.0f) & (kappa > 0.0f);
        vi u_lo = (vi)(0), u_hi = (vi)(width - 1);
        vi v_lo = (vi)(line_first), v_hi = (vi)(line_last);
        if (cutoff2 > 0.0f) {
            const vf shrink = 1.0f - cutoff2 * ik;
            const vf t11 = l11 * l11 * shrink - cutoff2 * b1 * b1;
            const vf t12 = l11 * l12 * shrink - cutoff2 * b1 * b2;
            const vf t22 = (l12 * l12 + l22 * l22) * shrink - cutoff2 * b2 * b2;
            /* det T = shrink^2 det S - c shrink b' adj(S) b, again without large differences */
            const vf s_b1 = l11 * b2 - l12 * b1, s_b2 = l22 * b1;
            const vf det = shrink * (shrink * (l11 * l22) * (l11 * l22) - cutoff2 * (s_b1 * s_b1 + s_b2 * s_b2));
            drawn &= (shrink > 0.0f) & (det > 0.0f) & (t11 > 0.0f);
            const vf inv_t = 1.0f / det;
            const vf cu = cutoff2 * (t22 * b1 - t12 * b2) * inv_t;
            const vf cv = cutoff2 * (t11 * b2 - t12 * b1) * inv_t;
            const vf level = cutoff2 * (1.0f + b1 * cu + b2 * cv);
            const vf ru = sqrt(level * t22 * inv_t) * 1.0001f + 0.002f;
            const vf rv = sqrt(level * t11 * inv_t) * 1.0001f + 0.002f;
            const vf far = (vf)(4e6f);
            u_lo = max(u_lo, V_INT(ceil(clamp(u_whole + (u_rest + cu - ru), -far, far))));
            u_hi = min(u_hi, V_INT(floor(clamp(u_whole + (u_rest + cu + ru), -far, far))));
            v_lo = max(v_lo, V_INT(ceil(clamp(v_whole + (v_rest + cv - rv), -far, far))));
            v_hi = min(v_hi, V_INT(floor(clamp(v_whole + (v_rest + cv + rv), -far, far))));
        }
        drawn &= (u_hi >= u_lo) & (v_hi >= v_lo);
        u_lo = VI_PICK(1, u_lo, drawn);
        u_hi = VI_PICK(0, u_hi, drawn);
        v_lo = VI_PICK(1, v_lo, drawn);
        v_hi = VI_PICK(0, v_hi, drawn);
        u_min = VI_PICK(u_min, min(u_min, u_lo), drawn);
        u_max = VI_PICK(u_max, max(u_max, u_hi), drawn);
        v_min = VI_PICK(v_min, min(v_min, v_lo), drawn);
        v_max = VI_PICK(v_max, max(v_max, v_hi), drawn);

        /* from one row a field to one record a Gaussian */
        float fields[9 * LANES];
        int bounds[6 * LANES];
        VI_STORE(v_lo, bounds + 4 * LANES);
        VI_STORE(v_hi, bounds + 5 * LANES);
        if (V_ANY(drawn)) {
            V_STORE(u_rest, fields);
            V_STORE(v_rest, fields + LANES);
            V_STORE(l11, fields + 2 * LANES);
            V_STORE(l12, fields + 3 * LANES);
            V_STORE(l22, fields + 4 * LANES);
            V_STORE(b1, fields + 5 * LANES);
            V_STORE(b2, fields + 6 * LANES);
            V_STORE(ik, fields + 7 * LANES);
            V_STORE(amp, fields + 8 * LANES);
            VI_STORE(V_INT(u_whole), bounds);
            VI_STORE(V_INT(v_whole), bounds + LANES);
            VI_STORE(u_lo, bounds + 2 * LANES);
            VI_STORE(u_hi, bounds + 3 * LANES);
        }
        for (int lane = 0; lane < LANES; ++lane) {
            __global float *rec = records + ((size_t)(first + lane) * cell_count + c) * RECORD;
            __global int *whole = (__global int *)rec;
            const int hi = bounds[5 * LANES + lane];
            if (hi >= bounds[4 * LANES + lane]) {
                for (int f = 0; f < 9; ++f)
                    rec[f] = fields[f * LANES + lane];
                for (int f = 0; f < 6; ++f)
                    whole[9 + f] = bounds[f * LANES + lane];
            } else {
                whole[REC_V_LO] = 1;
                whole[REC_V_HI] = 0;
            }
        }
    }
    __global int *e = extents + first;
    VI_STORE(u_min, e);
    VI_STORE(u_max, e + stride);
    VI_STORE(v_min, e + 2 * stride);
    VI_STORE(v_max, e + 3 * stride);
    VI_STORE((vi)(0), e + 4 * stride);
    VI_STORE((vi)(0), e + 5 * stride);
}
