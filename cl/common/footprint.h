/* The pixels that a splat covers in one cell, line by line: the same for the projector and its adjoint. */
#include "common/splat_moving.h"

/* a splat on one line, and its pixels u_lo..u_hi there */
typedef struct {
#if MOVING
    moving_line s;
    float amp, speed, middle, half_time; /* amp: times the line's share of its window in this segment */
#else
    splat_line s;
#endif
    float dv, u_rest;
    int v, u_lo, u_hi, u_whole;
} footprint_line;

#if MOVING
ALWAYS_INLINE footprint_line footprint_at(SPLAT_SPACE const float *rec, SPLAT_SPACE const float *cell, const int v, const float dv,
                                          const float middle, const float half_time, const float weight,
                                          const float4 path_limits)
#else
ALWAYS_INLINE footprint_line footprint_at(SPLAT_SPACE const float *rec, SPLAT_SPACE const float *cell, const int v, const float dv)
#endif
{
    SPLAT_SPACE const int *whole = (SPLAT_SPACE const int *)rec;
    footprint_line line;
#if MOVING
    line.s = moving_on_line(rec, cell, (float)v, dv, middle, half_time, weight, path_limits);
    line.amp = rec[REC_AMP] * weight;
    line.speed = rec[REC_SPEED];
    line.middle = middle;
    line.half_time = half_time;
#else
    line.s = splat_on_line(rec, cell, (float)v, dv);
#endif
    line.v = v;
    line.dv = dv;
    line.u_lo = whole[REC_U_LO];
    line.u_hi = whole[REC_U_HI];
    line.u_whole = whole[REC_U_WHOLE];
    line.u_rest = rec[REC_U_REST];
    return line;
}

/* the same for whoever looks at one line alone; `times`: the cell's (TIME_ROWS, time_pitch), if splats move */
ALWAYS_INLINE footprint_line footprint_alone(SPLAT_SPACE const float *rec, SPLAT_SPACE const float *cell,
                                             __global const float *times, const int time_pitch, const int v,
                                             const float4 path_limits)
{
    const float dv = (float)(v - ((SPLAT_SPACE const int *)rec)[REC_V_WHOLE]) - rec[REC_V_REST];
#if MOVING
    return footprint_at(rec, cell, v, dv, times[v], times[TIME_HALF * time_pitch + v],
                        times[TIME_WEIGHT * time_pitch + v], path_limits);
#else
    return footprint_at(rec, cell, v, dv);
#endif
}

/* offset of the pixels u.. of a line from the splat's centre */
ALWAYS_INLINE vf footprint_du(const footprint_line line, const int u)
{
    return ((float)(u - line.u_whole) + V_IOTA) - line.u_rest;
}
