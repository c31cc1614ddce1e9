/* Multi-pose preparation: every Gaussian seen from every time cell of a frame, in one launch.
   A work-item takes LANES Gaussians and walks the cells. With MOVING a cell is a segment of the frame in which the
   centre moves. Twins: operators/twins/splat.py, operators/twins/splat_moving.py. */
#include "common/precise.h"
#include "common/gaussian.h"
#include "common/splat_moving.h"

#if FOOTPRINT
/* A pixel averages over its area: its variance is added to the splat's, (S^-1 + E)^-1 = (S + E det S) / delta with
   delta = 1 + E tr S + E^2 det S. Returns what the amplitude is multiplied by so that the mass stays. */
ALWAYS_INLINE vf widened_by_pixel(vf *l11, vf *l12, vf *l22)
{
    const vf det_s = (*l11 * *l22) * (*l11 * *l22);
    const vf trace = *l11 * *l11 + *l12 * *l12 + *l22 * *l22;
    const vf inv = 1.0f / (1.0f + PIXEL_VARIANCE * (trace + PIXEL_VARIANCE * det_s));
    const vf wide11 = sqrt((*l11 * *l11 + PIXEL_VARIANCE * det_s) * inv);
    *l12 = *l11 * *l12 * inv / wide11;
    *l22 = sqrt(det_s * inv) / wide11;
    *l11 = wide11;
    return sqrt(inv);
}
#endif

#if MOVING
#define POSES 3 /* the middle of the segment and its two ends */
#define FIELDS 12

typedef struct { vf path_u, path_v, shift_u, shift_v; vi in_front; } moved_ends;

/* The path of the centre over the segment, and what to add to the centre at mid-time so that the straight path is right
   in the mean: a path bent by s t^2 has the mean s/12. `whole`, `rest`: the centre at mid-time. */
ALWAYS_INLINE moved_ends moved_to_ends(__global const coefficient *m, const v3 mean, const vf u_whole, const vf u_rest,
                                       const vf v_whole, const vf v_rest)
{
    moved_ends r;
    vf u[2], v[2];
    r.in_front = (vi)(-1);
    for (int end = 0; end < 2; ++end, m += 12) {
        const vwide depth = wide_dot(m + 8, mean.x, mean.y, mean.z);
        vf u_part, v_part;
        const vf u_at = wide_ratio(wide_dot(m, mean.x, mean.y, mean.z), depth, &u_part);
        const vf v_at = wide_ratio(wide_dot(m + 4, mean.x, mean.y, mean.z), depth, &v_part);
        u[end] = (u_at - u_whole) + (u_part - u_rest);
        v[end] = (v_at - v_whole) + (v_part - v_rest);
        r.in_front &= wide_value(depth) > 0.0f;
    }
    r.path_u = u[1] - u[0];
    r.path_v = v[1] - v[0];
    r.shift_u = (u[0] + u[1]) * (1.0f / 6.0f);
    r.shift_v = (v[0] + v[1]) * (1.0f / 6.0f);
    return r;
}

/* narrows [lo, hi] to the pixels within `reach` of the centre's path between two times */
ALWAYS_INLINE void segment_box(const vf whole, const vf rest, const vf path, const vf reach, const vf early,
                               const vf late, vi *lo, vi *hi)
{
    const vf from = path * early, to = path * late, far = (vf)(4e6f);
    *lo = max(*lo, V_INT(ceil(clamp(whole + (rest + min(from, to) - reach), -far, far))));
    *hi = min(*hi, V_INT(floor(clamp(whole + (rest + max(from, to) + reach), -far, far))));
}

/* Earliest and latest time at which any of the lines lo..hi integrates. Windows open and close in the order of the
   lines, so that the two outermost lines tell. */
ALWAYS_INLINE void times_of_lines(__global const float *times, const int pitch, const vi lo, const vi hi,
                                  vf *early, vf *late)
{
    float from[LANES], to[LANES];
    int first[LANES], last[LANES];
    VI_STORE(lo, first);
    VI_STORE(hi, last);
    for (int lane = 0; lane < LANES; ++lane) {
        from[lane] = to[lane] = 0.0f;
        if (last[lane] < first[lane])
            continue;
        const float middle_a = times[first[lane]], half_a = times[TIME_HALF * pitch + first[lane]];
        const float middle_b = times[last[lane]], half_b = times[TIME_HALF * pitch + last[lane]];
        from[lane] = min(middle_a - half_a, middle_b - half_b);
        to[lane] = max(middle_a + half_a, middle_b + half_b);
    }
    *early = V_LOAD(from);
    *late = V_LOAD(to);
}
#else
#define POSES 1
#define FIELDS 9
#endif

/* Depth of a centre, 1 on the detector, below which nothing is drawn: float32 cannot tell such a place from the source's
   own plane, and derivatives grow with its inverse. */
#define NEAREST 1e-6f

__kernel void splat_prepare(
    __global const float *gaussians,      /* (11, stride) */
    __global const float *cells,          /* (C, CELL) */
    __global const coefficient *matrices, /* (C, POSES, 12): rows give u z, v z and z of a world point */
    __global const int *cell_lines,       /* (C, 2): first line, line after the last */
    __global const float *line_times,     /* MOVING: (C, TIME_ROWS, time_pitch) */
    const int time_pitch,
    const int cell_count,
    const int count,
    const int stride,
    const int width,                      /* pixels across the lines */
    const float cutoff2,                  /* squared Mahalanobis radius; 0 = no cutoff */
    __global float *records,              /* (stride, C, RECORD), left as it was where nothing is drawn */
    __global uchar *seen,                 /* (stride, C): 1 where a record was written */
    __global int *extents)                /* (6, stride): u lo hi, v lo hi, 0 0 over all cells */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    const gaussian g = gaussian_load(gaussians, first, stride);
    const v3 mean = g.mean, scale = g.scale, inv_scale = g.inv_scale;
    const frame3 axes = g.axes;
    const vf inv_det = inv_scale.x * inv_scale.y * inv_scale.z;
    const vi exists = V_INT((vf)(first) + V_IOTA) < count;

    vi u_min = (vi)(0x7fffffff), v_min = u_min;
    vi u_max = (vi)(-1), v_max = u_max;

    for (int c = 0; c < cell_count; ++c) {
        __global const float *cell = cells + c * CELL;
        __global const coefficient *m = matrices + c * POSES * 12;
        const int line_first = cell_lines[2 * c], line_last = cell_lines[2 * c + 1] - 1;
        vf u_rest, v_rest;
        const vwide depth = wide_dot(m + 8, mean.x, mean.y, mean.z);
        const vf u_whole = wide_ratio(wide_dot(m, mean.x, mean.y, mean.z), depth, &u_rest);
        const vf v_whole = wide_ratio(wide_dot(m + 4, mean.x, mean.y, mean.z), depth, &v_rest);
        const vf z = wide_value(depth);
#if MOVING
        const moved_ends ends = moved_to_ends(m + 12, mean, u_whole, u_rest, v_whole, v_rest);
        u_rest += ends.shift_u;
        v_rest += ends.shift_v;
#endif

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
        vf l11 = gu_length * factor;
        vf l12 = v3_dot(gu, gv) / gu_length * factor;
        vf l22 = z * z * z * fabs((vf)(cell[CELL_VOLUME])) * inv_det * root / l11;
#if AFFINE
        const vf b1 = (vf)(0.0f), b2 = (vf)(0.0f), ik = (vf)(0.0f);
        const vf ray_length = sqrt(v3_dot(ray, ray)) / z;
#else
        const vf b1 = z * inv_kappa * v3_dot(white, v3_mul(eu, inv_scale));
        const vf b2 = z * inv_kappa * v3_dot(white, v3_mul(ev, inv_scale));
        const vf ik = inv_kappa;
        const vf ray_length = (vf)(1.0f);
#endif
        vf amp = cell[CELL_WEIGHT] * 2.50662827463f * g.density * factor * ray_length;
#if FOOTPRINT
        amp *= widened_by_pixel(&l11, &l12, &l22);
#endif

        /* the ellipse q <= cutoff2 is D'TD - 2 c b.D - c <= 0 with T = S (1 - c/kappa) - c b b' */
        vi drawn = exists & (z > NEAREST) & (kappa > 0.0f);
#if MOVING
        drawn &= ends.in_front;
        const vf pu = ends.path_u, pv = ends.path_v;
        const vf wide_u = l11 * pu + l12 * pv, wide_v = l22 * pv;
        const vf speed = sqrt(wide_u * wide_u + wide_v * wide_v);
        const vi moves = speed > 1e-6f; /* else any direction will do */
        const vf inv_speed = 1.0f / V_PICK(1.0f, speed, moves);
        const vf cosine = V_PICK(1.0f, wide_u * inv_speed, moves), sine = V_PICK(0.0f, wide_v * inv_speed, moves);
        vf reach2 = (vf)(MAXFLOAT);
#endif
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
#if MOVING
            /* Q is kept from the middle of the segment: both the box and the reach allow for what it changes by */
            const vf tilt = fabs(b1) * (fabs(cu) + ru + 0.75f * fabs(pu)) + fabs(b2) * (fabs(cv) + rv + 0.75f * fabs(pv));
            const vf farthest = sqrt(cutoff2) + 0.75f * speed;
            const vf slack = (1.0f + 1.1f * tilt) * (1.0f + 1.1f * tilt) / max(1.0f - 1.2f * farthest * farthest * ik, 0.1f);
            reach2 = cutoff2 * slack * 1.0001f;
            const vf root = sqrt(reach2 / (l11 * l11 * l22 * l22));
            const vf half_u = root * sqrt(l12 * l12 + l22 * l22) + 0.002f, half_v = root * l11 + 0.002f;
            vf early = (vf)(-0.75f), late = (vf)(0.75f); /* lines may stay a quarter of a segment longer */
            segment_box(v_whole, v_rest, pv, half_v, early, late, &v_lo, &v_hi);
            times_of_lines(line_times + (size_t)c * TIME_ROWS * time_pitch, time_pitch, v_lo, v_hi, &early, &late);
            segment_box(u_whole, u_rest, pu, half_u, early, late, &u_lo, &u_hi);
#else
            const vf far = (vf)(4e6f);
            u_lo = max(u_lo, V_INT(ceil(clamp(u_whole + (u_rest + cu - ru), -far, far))));
            u_hi = min(u_hi, V_INT(floor(clamp(u_whole + (u_rest + cu + ru), -far, far))));
            v_lo = max(v_lo, V_INT(ceil(clamp(v_whole + (v_rest + cv - rv), -far, far))));
            v_hi = min(v_hi, V_INT(floor(clamp(v_whole + (v_rest + cv + rv), -far, far))));
#endif
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

        /* from one row per field to one record per Gaussian */
        float fields[FIELDS * LANES];
        int bounds[6 * LANES];
        VI_STORE(v_lo, bounds + 4 * LANES);
        VI_STORE(v_hi, bounds + 5 * LANES);
        if (V_ANY(drawn)) {
#if MOVING
            V_STORE(l11 * cosine, fields);
            V_STORE(l12 * cosine + l22 * sine, fields + LANES);
            V_STORE(l22 * cosine - l12 * sine, fields + 2 * LANES);
            V_STORE(l11 * -sine, fields + 9 * LANES);
            V_STORE(speed, fields + 10 * LANES);
            V_STORE(reach2, fields + 11 * LANES);
#else
            V_STORE(l11, fields);
            V_STORE(l12, fields + LANES);
            V_STORE(l22, fields + 2 * LANES);
#endif
            V_STORE(u_rest, fields + 3 * LANES);
            V_STORE(v_rest, fields + 4 * LANES);
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
            const size_t at = (size_t)(first + lane) * cell_count + c;
            const int is_drawn = bounds[5 * LANES + lane] >= bounds[4 * LANES + lane];
            seen[at] = (uchar)is_drawn;
            if (is_drawn) {
                __global float *rec = records + at * RECORD;
                __global int *whole = (__global int *)rec;
                for (int f = 0; f < 9; ++f)
                    rec[f] = fields[f * LANES + lane];
                for (int f = 9; f < FIELDS; ++f)
                    rec[f + 6] = fields[f * LANES + lane];
                for (int f = 0; f < 6; ++f)
                    whole[9 + f] = bounds[f * LANES + lane];
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
