/* The pixels that a splat covers from one time cell, line by line. The projector and its adjoint both use this. */
#include "common/splat_moving.h"

/* A splat on line v, with its pixels u_lo..u_hi there. Its centre is at u_whole + u_rest along the line, and at v - dv. */
typedef struct {
#if MOVING
    moving_line s;
    float amp, speed, middle, half_time; /* amp: the peak times the fraction of the line's exposure in this segment */
#else
    splat_line s;
#endif
    float dv, u_rest;
    int v, u_lo, u_hi, u_whole;
} footprint_line;

#if MOVING
ALWAYS_INLINE footprint_line footprint_at(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell, const int v, const float dv,
                                          const float middle, const float half_time, const float weight,
                                          const float4 path_limits)
#else
ALWAYS_INLINE footprint_line footprint_at(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell, const int v, const float dv)
#endif
{
    SPLAT_SPACE const int *record_as_int = (SPLAT_SPACE const int *)splat_record;
    footprint_line line;
#if MOVING
    line.s = moving_on_line(splat_record, cell, (float)v, dv, middle, half_time, weight, path_limits);
    line.amp = splat_record[REC_AMP] * weight;
    line.speed = splat_record[REC_SPEED];
    line.middle = middle;
    line.half_time = half_time;
#else
    line.s = splat_on_line(splat_record, cell, (float)v, dv);
#endif
    line.v = v;
    line.dv = dv;
    line.u_lo = record_as_int[REC_U_LO];
    line.u_hi = record_as_int[REC_U_HI];
    line.u_whole = record_as_int[REC_U_WHOLE];
    line.u_rest = splat_record[REC_U_REST];
    return line;
}

/* footprint_at for line v. If splats move, it reads the line's times from `times`, the cell's (TIME_ROWS, time_pitch). */
ALWAYS_INLINE footprint_line footprint_alone(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell,
                                             __global const float *times, const int time_pitch, const int v,
                                             const float4 path_limits)
{
    const float dv = (float)(v - ((SPLAT_SPACE const int *)splat_record)[REC_V_WHOLE]) - splat_record[REC_V_REST];
#if MOVING
    return footprint_at(splat_record, cell, v, dv, times[v], times[TIME_HALF * time_pitch + v],
                        times[TIME_WEIGHT * time_pitch + v], path_limits);
#else
    return footprint_at(splat_record, cell, v, dv);
#endif
}

/* The offsets of LANES pixels, from u on, from the splat's centre. */
ALWAYS_INLINE vf footprint_du(const footprint_line line, const int u)
{
    return ((float)(u - line.u_whole) + V_IOTA) - line.u_rest;
}

#if GROUP > 1
/* footprint_alone, but with only the pixels within the cutoff. With t = l11 du + t0 and B = beta t + gamma, the condition
   num <= cutoff2 Q is quadratic in t. Solved in t instead of du, it keeps its digits also for needles (thin Gaussians). */
ALWAYS_INLINE footprint_line footprint_within(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell,
                                              __global const float *times, const int time_pitch, const int v,
                                              const float4 path_limits, const float cutoff2)
{
    footprint_line line = footprint_alone(splat_record, cell, times, time_pitch, v, path_limits);
#if MOVING
    moving_span(splat_record, line.dv, line.middle, line.half_time, times[TIME_WEIGHT * time_pitch + v], cutoff2 > 0.0f,
                &line.u_lo, &line.u_hi);
#else
    if (cutoff2 > 0.0f) {
        const float per = 1.0f / line.s.l11, beta = line.s.b1 * per, gamma = line.s.b0 - beta * line.s.t0;
        const float shrink = 1.0f - cutoff2 * line.s.inv_kappa, a = shrink - cutoff2 * beta * beta; /* both > 0, as the cutoff is an ellipse */
        const float left = shrink * (cutoff2 * gamma * gamma - line.s.k * a);
        const float middle = cutoff2 * beta * gamma / a, reach = sqrt(max(left, 0.0f)) / a;
        const float centre = line.u_rest - line.s.t0 * per, far = 4e6f;
        line.u_lo = max(line.u_lo, line.u_whole + convert_int(ceil(clamp(centre + (middle - reach) * per - 0.01f, -far, far))));
        line.u_hi = min(line.u_hi, line.u_whole + convert_int(floor(clamp(centre + (middle + reach) * per + 0.01f, -far, far))));
        if (left < 0.0f) /* the line misses the ellipse */
            line.u_hi = line.u_lo - 1;
    }
#endif
    return line;
}
#endif
