/* A splat that moves during a segment of a frame's time (docs/mathematics.md, "Exact in time").
   Time t goes from -1/2 to 1/2 in a segment. The splat's centre is displaced by t p, where p is its path. Shape and
   amplitude are those at t = 0. V is a factor of S (V'V = S), turned so that V p = (speed, 0). For a pixel at D:

       along = V1.D,  across = V2.D,   q(t) = ((along - speed t)^2 + across^2) / Q

   Its line integrates exp(-q/2) over the line's exposure [middle - half, middle + half] in the segment. */
#include "common/splat.h"

/* Rows of the table of a cell's lines; a row has `time_pitch` floats. */
#define TIME_MIDDLE 0
#define TIME_HALF 1
#define TIME_WEIGHT 2 /* fraction of the line's exposure that lies in this segment */
#define TIME_ROWS 3
#define TIMES_OF(c, line_times, time_pitch) ((line_times) + (size_t)(c) * TIME_ROWS * (time_pitch))

#if MOVING
#define LANE(type, v, lane) (((type *)&(v))[lane])
#define CLOSED 0 /* a rule that integrates in closed form; other rules are the number of Gauss-Legendre times */
#define GAUSS_2 0.57735026919f
#define GAUSS_3 0.77459666924f
#define ROOT_HALF 0.70710678119f
#define ROOT_HALF_PI 1.25331413732f

/* The terms of a moving splat that are constant along one line. z = along - speed * middle. */
typedef struct {
    float z1, z0, c1, c0, shift, b1, b0, inv_kappa, amplitude, half_path, d0, d1, d2;
    int rule;
} moving_line;

/* The fastest rule that is accurate enough. path: its length in the line's exposure, in standard deviations of the splat.
   limits: the longest paths for 1, 2 and 3 times. */
ALWAYS_INLINE int moving_rule(const float path, const float4 limits)
{
    return path <= limits.x ? 1 : (path <= limits.y ? 2 : (path <= limits.z ? 3 : CLOSED));
}

ALWAYS_INLINE moving_line moving_on_line(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell, const float v,
                                         const float dv, const float middle, const float half_time, const float weight,
                                         const float4 limits)
{
    moving_line s;
    const float speed = splat_record[REC_SPEED];
    s.shift = speed * middle;
    s.half_path = speed * half_time;
    s.z1 = splat_record[REC_ALONG_U];
    s.z0 = splat_record[REC_ALONG_V] * dv - s.shift;
    s.c1 = splat_record[REC_ACROSS_U];
    s.c0 = splat_record[REC_ACROSS_V] * dv;
    s.b1 = splat_record[REC_B1];
    s.b0 = 1.0f + splat_record[REC_B2] * dv;
    s.inv_kappa = splat_record[REC_INV_KAPPA];
    s.d0 = cell[CELL_D00] + v * (cell[CELL_DV] + cell[CELL_DVV] * v);
    s.d1 = cell[CELL_DU] + cell[CELL_DUV] * v;
    s.d2 = cell[CELL_DUU];
    s.rule = moving_rule(2.0f * s.half_path, limits);
    s.amplitude = splat_record[REC_AMP] * weight;
    if (s.rule == CLOSED)
        s.amplitude *= ROOT_HALF_PI / (2.0f * s.half_path);
    return s;
}

/* A pixel relative to the splat. fall: the factor of squares in the exponent of 2. c2: across^2. d2: |d|^2, or 1 if AFFINE.
   drawn: whether the pixel is within the cutoff. */
typedef struct { vf z, across, b, q, rq, fall, c2, d2; vi drawn; } moving_pixel;

#if AFFINE
#define SQUARE_ROOT(x) (x) /* no root is needed: Q and |d|^2 are 1 */
#else
#define SQUARE_ROOT(x) sqrt(x)
#endif

ALWAYS_INLINE moving_pixel moving_at(const moving_line s, const vf u, const vf du, const float limit)
{
    moving_pixel p;
    p.z = s.z1 * du + s.z0;
    p.across = s.c1 * du + s.c0;
    const vf ahead = p.z - clamp(p.z, -s.half_path, s.half_path);
    p.c2 = p.across * p.across;
#if AFFINE
    p.b = p.q = p.rq = p.d2 = (vf)(1.0f);
    p.fall = (vf)(MINUS_HALF_LOG2E);
    p.drawn = (ahead * ahead + p.c2) <= limit;
#else
    const vf along = p.z + s.shift;
    p.b = s.b1 * du + s.b0;
    p.q = p.b * p.b + (along * along + p.c2) * s.inv_kappa;
    p.rq = 1.0f / p.q;
    p.fall = MINUS_HALF_LOG2E * p.rq;
    p.d2 = (s.d2 * u + s.d1) * u + s.d0;
    p.drawn = (ahead * ahead + p.c2) * p.rq <= limit;
#endif
    return p;
}

/* Returns D, where 1 - erf|x| = 1/D with an error of 3e-7 (Abramowitz and Stegun 7.1.28). Beyond |x| = 5 D is constant. */
ALWAYS_INLINE vf erf_complement(const vf x)
{
    const vf t = min(fabs(x), 5.0f);
    vf d = 1.0f + t * (0.0705230784f + t * (0.0422820123f + t * (0.0092705272f
                + t * (0.0001520143f + t * (0.0002765672f + t * 0.0000430638f)))));
    d *= d;
    d *= d;
    d *= d;
    return d * d;
}

/* erf(x1) - erf(x0) with one division. */
ALWAYS_INLINE vf erf_between(const vf x0, const vf x1)
{
    const vf d0 = erf_complement(x0), d1 = erf_complement(x1);
    const vf inv = 1.0f / (d0 * d1);
    return copysign(1.0f - d0 * inv, x1) - copysign(1.0f - d1 * inv, x0);
}

ALWAYS_INLINE vf moving_exp(const vf z, const moving_pixel p)
{
    return falling_exp2((z * z + p.c2) * p.fall);
}

/* The pixel's line integral, averaged over its line's exposure. `rule` is a constant where this is inlined. */
ALWAYS_INLINE vf moving_value(const int rule, const moving_line s, const moving_pixel p)
{
    if (rule == CLOSED) {
        const vf k = ROOT_HALF * SQUARE_ROOT(p.rq);
        const vf m = erf_between((-s.half_path - p.z) * k, (s.half_path - p.z) * k);
        return s.amplitude * SQUARE_ROOT(p.d2) * falling_exp2(p.c2 * p.fall) * m;
    }
    const vf factor = s.amplitude * SQUARE_ROOT(p.d2 * p.rq);
    if (rule == 1)
        return factor * moving_exp(p.z, p);
    const float step = s.half_path * (rule == 2 ? GAUSS_2 : GAUSS_3);
    const vf ends = moving_exp(p.z - step, p) + moving_exp(p.z + step, p);
    if (rule == 2)
        return factor * 0.5f * ends;
    return factor * (0.27777777778f * ends + 0.44444444444f * moving_exp(p.z, p));
}

/* Means over the line's exposure of E, E z, E z^2, E t and E t z, where E = exp(-q/2) and z = along - speed t. */
typedef struct { vf e, ez, ezz, et, etz; } moving_means;

ALWAYS_INLINE void moving_add(moving_means *m, const moving_line s, const moving_pixel p, const float weight,
                              const float step, const float time)
{
    const vf z = p.z - s.half_path * step;
    const vf e = weight * moving_exp(z, p), ez = e * z;
    m->e += e;
    m->ez += ez;
    m->ezz += ez * z;
    m->et += e * time;
    m->etz += ez * time;
}

/* The closed form. With E = e0 and e1 at both ends, int E z = Q (e1 - e0)/speed and
   int E z^2 = Q (int E + (z1 e1 - z0 e0)/speed). The rule CLOSED has only long paths, for which differences keep digits. */
ALWAYS_INLINE moving_means moving_closed(const moving_line s, const moving_pixel p, const float speed)
{
    moving_means m;
    const vf z0 = p.z + s.half_path, z1 = p.z - s.half_path;
    const vf e0 = moving_exp(z0, p), e1 = moving_exp(z1, p);
    const float per_path = 1.0f / (2.0f * s.half_path);
    const vf root_q = SQUARE_ROOT(p.q), k = ROOT_HALF * root_q * p.rq;
    m.e = ROOT_HALF_PI * per_path * root_q * falling_exp2(p.c2 * p.fall) * erf_between(-z0 * k, -z1 * k);
    m.ez = p.q * per_path * (e1 - e0);
    m.ezz = p.q * (m.e + per_path * (z1 * e1 - z0 * e0));
    const vf along = p.z + s.shift;
    const float per_speed = 1.0f / speed;
    m.et = (along * m.e - m.ez) * per_speed;
    m.etz = (along * m.ez - m.ezz) * per_speed;
    return m;
}

ALWAYS_INLINE moving_means moving_all_means(const moving_line s, const moving_pixel p, const float speed,
                                            const float middle, const float half_time)
{
    if (s.rule == CLOSED)
        return moving_closed(s, p, speed);
    moving_means m;
    m.e = m.ez = m.ezz = m.et = m.etz = (vf)(0.0f);
    if (s.rule == 1)
        moving_add(&m, s, p, 1.0f, 0.0f, middle);
    else if (s.rule == 2) {
        moving_add(&m, s, p, 0.5f, -GAUSS_2, middle - GAUSS_2 * half_time);
        moving_add(&m, s, p, 0.5f, GAUSS_2, middle + GAUSS_2 * half_time);
    } else {
        moving_add(&m, s, p, 0.27777777778f, -GAUSS_3, middle - GAUSS_3 * half_time);
        moving_add(&m, s, p, 0.44444444444f, 0.0f, middle);
        moving_add(&m, s, p, 0.27777777778f, GAUSS_3, middle + GAUSS_3 * half_time);
    }
    return m;
}

/* Finds the pixels that the splat reaches during each line's exposure, for LANES lines at distances dv. In coordinates
   (along, across) the region is a disc at either end of the path, and a rectangle between them. Lines that are not exposed
   in this segment get no pixels. */
ALWAYS_INLINE void moving_span(SPLAT_SPACE const float *splat_record, const vf dv, const vf middle, const vf half_time,
                               const vf weight, const int cuts, vi *u_lo, vi *u_hi)
{
    SPLAT_SPACE const int *record_as_int = (SPLAT_SPACE const int *)splat_record;
    *u_lo = (vi)(record_as_int[REC_U_LO]);
    *u_hi = VI_PICK(record_as_int[REC_U_LO] - 1, record_as_int[REC_U_HI], weight > 0.0f);
    if (!cuts)
        return;
    const float a1 = splat_record[REC_ALONG_U], c1 = splat_record[REC_ACROSS_U], reach2 = splat_record[REC_REACH2], speed = splat_record[REC_SPEED];
    const vf a0 = splat_record[REC_ALONG_V] * dv, c0 = splat_record[REC_ACROSS_V] * dv;
    const float norm = a1 * a1 + c1 * c1, per = 1.0f / norm;
    const vf none = (vf)(1e9f);
    vf lo = none, hi = -none;
    const vf path[2] = {(middle - half_time) * speed, (middle + half_time) * speed};
    for (int end = 0; end < 2; ++end) {
        const vf a = a0 - path[end];
        const vf cross = a1 * c0 - c1 * a;
        const vf left = reach2 * norm - cross * cross;
        const vi some = left >= 0.0f;
        const vf half_chord = sqrt(max(left, 0.0f)) * per, at = (a1 * a + c1 * c0) * -per;
        lo = min(lo, V_PICK(none, at - half_chord, some));
        hi = max(hi, V_PICK(-none, at + half_chord, some));
    }
    const float reach = sqrt(reach2), per_across = 1.0f / (fabs(c1) > 1e-12f ? c1 : 1e-12f);
    for (int side = -1; side <= 1; side += 2) {
        const vf at = ((float)side * reach - c0) * per_across;
        const vf along = a1 * at + a0;
        const vi some = (along >= path[0]) & (along <= path[1]);
        lo = min(lo, V_PICK(none, at, some));
        hi = max(hi, V_PICK(-none, at, some));
    }
    const float centre = splat_record[REC_U_REST], far = 4e6f;
    *u_lo = max(*u_lo, record_as_int[REC_U_WHOLE] + V_INT(ceil(clamp(lo + (centre - 0.01f), -far, far))));
    *u_hi = min(*u_hi, record_as_int[REC_U_WHOLE] + V_INT(floor(clamp(hi + (centre + 0.01f), -far, far))));
}
#endif
