/* Adjoint of splat_forward.cl, second pass: the chain rule from the sums of splat_backward.cl to gradients by mean, scale,
   rotation and density. A work-item takes LANES Gaussians and loops over the cells in a fixed order. */
#include "common/precise.h"
#include "common/gradient.h"
#include "common/splat_state.h"
#include "common/splat_sums.h"

#if MOVING
#define TURNED 4 /* floats of the record that are still needed: d(along, across)/d(u, v), a factor of S */
#define POSES 3  /* poses of a cell, as in splat_prepare.cl */
#else
#define TURNED 0
#define POSES (1 + FIXED_CONIC)
#endif

/* Adds dL/d(mean) from dL/d(u0, v0, depth z), with u0 = (row 0 . x) / z and v0 = (row 1 . x) / z. */
static inline void add_by_centre(v3 *by_mean, __global const coefficient *m, const vf u0, const vf v0, const vf inv_z,
                          const vf by_u0, const vf by_v0, const vf by_z)
{
    const vf cu = by_u0 * inv_z, cv = by_v0 * inv_z, cz = by_z - cu * u0 - cv * v0;
    by_mean->x += cu * COEFFICIENT(m[0]) + cv * COEFFICIENT(m[4]) + cz * COEFFICIENT(m[8]);
    by_mean->y += cu * COEFFICIENT(m[1]) + cv * COEFFICIENT(m[5]) + cz * COEFFICIENT(m[9]);
    by_mean->z += cu * COEFFICIENT(m[2]) + cv * COEFFICIENT(m[6]) + cz * COEFFICIENT(m[10]);
}

static inline v3 turning(v3 a, v3 b) { return v3_make(a.y * b.z, a.z * b.x, a.x * b.y); }

static inline vf torque_about(const vf forth, const vf back, const vf s2, const vf s3, const vf inv2, const vf inv3)
{
    return 0.5f * (forth * (s2 * inv3) + back * (s3 * inv2)) * out_of_round(s2, s3, inv2, inv3);
}

/* The torque is forth - back, the sum of (gradient x vector) over all vectors. Line integrals depend only on vectors divided
   by scales, and rotating these changes nothing: forth s2 / s3 = back s3 / s2. With this, the difference is formed without
   losing digits. */
static inline v3 torque_of(const v3 forth, const v3 back, const v3 s, const v3 inv)
{
    return v3_make(torque_about(forth.x, back.x, s.y, s.z, inv.y, inv.z),
                   torque_about(forth.y, back.y, s.z, s.x, inv.z, inv.x),
                   torque_about(forth.z, back.z, s.x, s.y, inv.x, inv.y));
}

#if DEFORMED
#define BY_PLACE by_place /* the gradient by the centre in the cell's state, not in the reference */

static inline void add_vector(__global float *rows, const int row, const int stride, const v3 by)
{
    __global float *at = rows + (size_t)row * stride;
    V_STORE(V_LOAD(at) + by.x, at);
    V_STORE(V_LOAD(at + stride) + by.y, at + stride);
    V_STORE(V_LOAD(at + 2 * (size_t)stride) + by.z, at + 2 * (size_t)stride);
}

/* Adds dL/dG. The 3x3 matrix G takes from_source, eu and ev from the object's state to the reference. */
static inline void add_by_pull(__global float *by_state, const int stride, const frame3 axes, const v3 from_source,
                               __global const float *cell, const v3 by_ray, const v3 by_eu, const v3 by_ev)
{
    const v3 x = to_world(axes, by_ray), u = to_world(axes, by_eu), v = to_world(axes, by_ev);
    const v3 eu = v3_make((vf)(cell[CELL_EU]), (vf)(cell[CELL_EU + 1]), (vf)(cell[CELL_EU + 2]));
    const v3 ev = v3_make((vf)(cell[CELL_EV]), (vf)(cell[CELL_EV + 1]), (vf)(cell[CELL_EV + 2]));
    add_vector(by_state, 3, stride, v3_add(v3_scale(from_source, x.x), v3_add(v3_scale(eu, u.x), v3_scale(ev, v.x))));
    add_vector(by_state, 6, stride, v3_add(v3_scale(from_source, x.y), v3_add(v3_scale(eu, u.y), v3_scale(ev, v.y))));
    add_vector(by_state, 9, stride, v3_add(v3_scale(from_source, x.z), v3_add(v3_scale(eu, u.z), v3_scale(ev, v.z))));
}
#else
#define BY_PLACE by_mean
#endif

__kernel void splat_chain(
    __global const float *gaussians,      /* (11, stride): mean, scale, quaternion, density */
    __global const float *cells,          /* (C, CELL): the time cells of the frame */
    __global const coefficient *matrices, /* (C, POSES, 12), as in splat_prepare */
    __global const float *records,        /* (stride, C, RECORD), with sums in them */
    __global const uchar *is_visible,     /* (stride, C): 1 where a splat has a record */
    const int cell_count, const int count, const int stride,
    const float half_width, const float half_lines,
    __global float *gradients,            /* (13, stride); DEFORMED: without the rows of the mean */
    __global const float *states,         /* DEFORMED: (S, STATE_ROWS, stride) */
    __global const int *cell_states,      /* (C, POSES): the state of the object at each pose */
    __global float *by_states)            /* DEFORMED: laid out like states; dL/d(states) is added to it */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    const gaussian g = gaussian_load(gaussians, first, stride);
    const v3 scale = g.scale, inv_scale = g.inv_scale;
    const vf det = scale.x * scale.y * scale.z;

    const vf zero = (vf)(0.0f);
    v3 by_mean = v3_make(zero, zero, zero), by_scale = by_mean;
    v3 forth = by_mean, back = by_mean; /* the two parts of the torque, see torque_of */
    vf by_log_density = zero, by_u0 = zero, by_v0 = zero;

    for (int c = 0; c < cell_count; ++c) {
        float fields[(SUM_COUNT + TURNED) * LANES], visible[LANES];
        int drawn = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            const size_t at = (size_t)(first + lane) * cell_count + c;
            const int here = first + lane < count && is_visible[at];
            __global const float *splat_record = records + at * RECORD;
            drawn |= here;
            visible[lane] = here;
            for (int f = 0; f < SUM_COUNT; ++f)
                fields[f * LANES + lane] = here ? splat_record[SUMS + f] : 0.0f;
#if MOVING
            fields[SUM_COUNT * LANES + lane] = here ? splat_record[REC_ALONG_U] : 1.0f;
            fields[(SUM_COUNT + 1) * LANES + lane] = here ? splat_record[REC_ALONG_V] : 0.0f;
            fields[(SUM_COUNT + 2) * LANES + lane] = here ? splat_record[REC_ACROSS_U] : 0.0f;
            fields[(SUM_COUNT + 3) * LANES + lane] = here ? splat_record[REC_ACROSS_V] : 1.0f;
#endif
        }
        if (!drawn)
            continue;
        const vf w = V_LOAD(fields + SUM_W * LANES), by_ik = V_LOAD(fields + SUM_IK * LANES);
#if MOVING
        /* dL/dS, from (along, across) = V D and D D' = V^-1 (along, across)(along, across)' V^-T. */
        const vf zz = V_LOAD(fields + SUM_ZZ * LANES), zc = V_LOAD(fields + SUM_ZC * LANES), cc = V_LOAD(fields + SUM_CC * LANES);
        const vf along_u = V_LOAD(fields + SUM_COUNT * LANES), along_v = V_LOAD(fields + (SUM_COUNT + 1) * LANES);
        const vf across_u = V_LOAD(fields + (SUM_COUNT + 2) * LANES), across_v = V_LOAD(fields + (SUM_COUNT + 3) * LANES);
        const vf per = 1.0f / (along_u * across_v - along_v * across_u);
        const vf uz = across_v * per, uc = -along_v * per, vz = -across_u * per, vc = along_u * per;
        vf s_uu = uz * (uz * zz + 2.0f * uc * zc) + uc * uc * cc;
        vf s_uv = 2.0f * (uz * (vz * zz + vc * zc) + uc * (vz * zc + vc * cc));
        vf s_vv = vz * (vz * zz + 2.0f * vc * zc) + vc * vc * cc;
        const vf s_z = V_LOAD(fields + SUM_Z * LANES), s_c = V_LOAD(fields + SUM_C * LANES);
        const vf s_tz = V_LOAD(fields + SUM_TZ * LANES), s_tc = V_LOAD(fields + SUM_TC * LANES);
#else
        vf s_uu = V_LOAD(fields + SUM_UU * LANES), s_uv = 2.0f * V_LOAD(fields + SUM_UV * LANES);
        vf s_vv = V_LOAD(fields + SUM_VV * LANES);
        const vf s_u = V_LOAD(fields + SUM_U * LANES), s_v = V_LOAD(fields + SUM_V * LANES);
#endif
        const vf s_b = V_LOAD(fields + SUM_B * LANES), by_b1 = V_LOAD(fields + SUM_BU * LANES), by_b2 = V_LOAD(fields + SUM_BV * LANES);

        __global const float *state = states + STATE_AT(cell_states[c * POSES], first, stride);
        const gaussian seen = gaussian_in_state(g, state, stride);
        const v3 mean = seen.mean;
        const frame3 axes = seen.axes;
        __global const float *cell = cells + c * CELL;
        __global const coefficient *m = matrices + c * POSES * 12;
        /* A Gaussian that is not drawn may be at the source, where its gradient would be 0/0. Its sums are 0, so any other
           place serves for it. */
        const vi is_in_view = V_LOAD(visible) > 0.0f;
        const vf z = V_PICK((vf)(1.0f), wide_value(wide_dot(m + 8, mean.x, mean.y, mean.z)), is_in_view);
        const vf inv_z = 1.0f / z;
        const vf u0 = wide_value(wide_dot(m, mean.x, mean.y, mean.z)) * inv_z;
        const vf v0 = wide_value(wide_dot(m + 4, mean.x, mean.y, mean.z)) * inv_z;
        const v3 end = PARALLEL ? v3_make(zero, zero, zero) : mean;
        const v3 from_source = v3_make(end.x - cell[CELL_SOURCE], end.y - cell[CELL_SOURCE + 1],
                                       end.z - cell[CELL_SOURCE + 2]);
        const v3 straight = v3_make(V_PICK((vf)(1.0f), from_source.x, is_in_view), V_PICK((vf)(0.0f), from_source.y, is_in_view),
                                    V_PICK((vf)(0.0f), from_source.z, is_in_view));
        const v3 ray = to_local(axes, straight);
        const v3 eu = to_local(axes, v3_make((vf)(cell[CELL_EU]), (vf)(cell[CELL_EU + 1]), (vf)(cell[CELL_EU + 2])));
        const v3 ev = to_local(axes, v3_make((vf)(cell[CELL_EV]), (vf)(cell[CELL_EV + 1]), (vf)(cell[CELL_EV + 2])));
        const v3 white = v3_mul(ray, inv_scale);
        const vf kappa = v3_dot(white, white);
        const vf inv_kappa = 1.0f / kappa;

        /* S = z^2 / (kappa det^2) a_i.a_j with a_i = scale * (ray x e_i). */
        const v3 mu = v3_cross(ray, eu), mv = v3_cross(ray, ev);
        const v3 au = v3_mul(scale, mu), av = v3_mul(scale, mv);
        const vf factor = (z / det) * (z / det) * inv_kappa;
        const vf s11 = factor * v3_dot(au, au), s12 = factor * v3_dot(au, av), s22 = factor * v3_dot(av, av);
        const vf t_s = s_uu * s11 + s_uv * s12 + s_vv * s22;
        const v3 by_au = v3_scale(v3_add(v3_scale(au, 2.0f * s_uu), v3_scale(av, s_uv)), factor);
        const v3 by_av = v3_scale(v3_add(v3_scale(av, 2.0f * s_vv), v3_scale(au, s_uv)), factor);
        const v3 by_mu = v3_mul(scale, by_au), by_mv = v3_mul(scale, by_av);
        v3 by_ray = v3_add(v3_cross(eu, by_mu), v3_cross(ev, by_mv));
        v3 by_eu = v3_cross(by_mu, ray), by_ev = v3_cross(by_mv, ray);
        v3 by_s = v3_add(v3_mul(mu, by_au), v3_mul(mv, by_av));
        by_s = v3_add(by_s, v3_scale(inv_scale, -2.0f * t_s));

        vf by_kappa = -inv_kappa * (t_s + 0.5f * w);
        vf by_z = inv_z * (2.0f * t_s);
        v3 by_white = v3_make(zero, zero, zero);
#if AFFINE
        const vf b1 = zero, b2 = zero;
#else
        /* b_i = z white.(e_i / scale) / kappa. */
        const v3 wu = v3_mul(eu, inv_scale), wv = v3_mul(ev, inv_scale);
        const vf ratio = z * inv_kappa;
        const vf b1 = ratio * v3_dot(white, wu), b2 = ratio * v3_dot(white, wv);
        const vf t_b = by_b1 * b1 + by_b2 * b2;
        by_kappa -= inv_kappa * (t_b + by_ik * inv_kappa);
        by_z += inv_z * (t_b + w);
        by_white = v3_scale(v3_add(v3_scale(wu, by_b1), v3_scale(wv, by_b2)), ratio);
        const v3 by_wu = v3_scale(white, ratio * by_b1), by_wv = v3_scale(white, ratio * by_b2);
        by_eu = v3_add(by_eu, v3_mul(by_wu, inv_scale));
        by_ev = v3_add(by_ev, v3_mul(by_wv, inv_scale));
        by_s = v3_add(by_s, v3_scale(v3_mul(inv_scale, v3_add(v3_mul(by_wu, wu), v3_mul(by_wv, wv))), -1.0f));
#endif
        by_white = v3_add(by_white, v3_scale(white, 2.0f * by_kappa));
        const v3 by_white_s = v3_mul(by_white, inv_scale);
        by_ray = v3_add(by_ray, by_white_s);
        forth = v3_add(forth, v3_add(turning(by_ray, ray), v3_add(turning(by_eu, eu), turning(by_ev, ev))));
        back = v3_add(back, v3_add(turning(ray, by_ray), v3_add(turning(eu, by_eu), turning(ev, by_ev))));
#if DEFORMED
        v3 by_place = v3_make(zero, zero, zero);
        __global float *by_state = by_states + (state - states);
        add_by_pull(by_state, stride, g.axes, straight, cell, by_ray, by_eu, by_ev);
#if AFFINE && !PARALLEL
        by_place = v3_scale(straight, w / v3_dot(straight, straight)); /* by the ray's length, on which G has no effect */
#endif
#elif AFFINE
        by_ray = v3_add(by_ray, v3_scale(ray, w / v3_dot(ray, ray))); /* by the ray's length, on which rotations have no effect */
#endif
        by_s = v3_add(by_s, v3_scale(v3_mul(by_white_s, white), -1.0f));

#if MOVING
        const vf g_u0 = -(2.0f * (along_u * s_z + across_u * s_c) + b1 * s_b);
        const vf g_v0 = -(2.0f * (along_v * s_z + across_v * s_c) + b2 * s_b);
#else
        const vf g_u0 = -(2.0f * (s11 * s_u + s12 * s_v) + b1 * s_b);
        const vf g_v0 = -(2.0f * (s12 * s_u + s22 * s_v) + b2 * s_b);
#endif
        by_scale = v3_add(by_scale, by_s);
        by_log_density += w;
        by_u0 += g_u0;
        by_v0 += g_v0;

#if !PARALLEL
        BY_PLACE = v3_add(BY_PLACE, to_world(axes, by_ray));
#endif
#if MOVING
        /* The centre is the mean of the path's parabola, (end 0 + 4 middle + end 1) / 6. The path is end 1 - end 0. */
        add_by_centre(&BY_PLACE, m, u0, v0, inv_z, 0.66666666667f * g_u0, 0.66666666667f * g_v0, by_z);
        const vf g_path_u = -2.0f * (along_u * s_tz + across_u * s_tc);
        const vf g_path_v = -2.0f * (along_v * s_tz + across_v * s_tc);
        for (int end = 0; end < 2; ++end) {
            __global const coefficient *n = m + 12 * (end + 1);
            const float sign = end ? 1.0f : -1.0f;
            const size_t end_state = STATE_AT(cell_states[c * POSES + 1 + end], first, stride);
            const v3 at = MEAN_IN_STATE(seen, states + end_state, stride);
            const vf inv = 1.0f / V_PICK((vf)(1.0f), wide_value(wide_dot(n + 8, at.x, at.y, at.z)), is_in_view);
#if DEFORMED
            v3 by_end = v3_make(zero, zero, zero);
#else
#define by_end by_mean
#endif
            add_by_centre(&by_end, n, wide_value(wide_dot(n, at.x, at.y, at.z)) * inv,
                          wide_value(wide_dot(n + 4, at.x, at.y, at.z)) * inv, inv,
                          0.16666666667f * g_u0 + sign * g_path_u, 0.16666666667f * g_v0 + sign * g_path_v, zero);
#if DEFORMED
            add_vector(by_states + end_state, 0, stride, by_end);
#endif
        }
#elif FIXED_CONIC
        /* The second pose gives the centre, the first the depth in shape and density. */
        __global const coefficient *n = m + 12;
        const vf inv = 1.0f / V_PICK((vf)(1.0f), wide_value(wide_dot(n + 8, mean.x, mean.y, mean.z)), is_in_view);
        add_by_centre(&by_mean, n, wide_value(wide_dot(n, mean.x, mean.y, mean.z)) * inv,
                      wide_value(wide_dot(n + 4, mean.x, mean.y, mean.z)) * inv, inv, g_u0, g_v0, zero);
        add_by_centre(&by_mean, m, zero, zero, inv_z, zero, zero, by_z);
#else
        add_by_centre(&BY_PLACE, m, u0, v0, inv_z, g_u0, g_v0, by_z);
#endif
#if DEFORMED
        add_vector(by_state, 0, stride, by_place);
#endif
    }
    __global float *out = gradients + first;
    gradient_store(out, stride, 0, by_mean, by_scale, torque_of(forth, back, scale, inv_scale), g.qw, g.qx, g.qy, g.qz,
                   by_log_density / g.density);
    V_STORE(by_u0 * half_width, out + (size_t)ROW_STATISTIC * stride);
    V_STORE(by_v0 * half_lines, out + (size_t)(ROW_STATISTIC + 1) * stride);
}
