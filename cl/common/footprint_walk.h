/* Calls visit(visitor, line) for each of the lines v_lo..v_hi on which a splat covers pixels, in order. The file that
   includes this must first define `visit` and the type VISITOR. */
ALWAYS_INLINE void walk_footprint(__global const float *splat_record, __global const float *cell, __global const float *times,
                                  const int time_pitch, const float4 path_limits, const float cutoff2,
                                  const int v_lo, const int v_hi, VISITOR *visitor)
{
#if MOVING
    const int v_whole = ((__global const int *)splat_record)[REC_V_WHOLE];
    for (int first = v_lo; first <= v_hi; first += LANES) {
        const vf dv = ((float)(first - v_whole) + V_IOTA) - splat_record[REC_V_REST];
        const vf middle = V_LOAD(times + first), half_time = V_LOAD(times + TIME_HALF * time_pitch + first);
        const vf weight = V_LOAD(times + TIME_WEIGHT * time_pitch + first);
        vi lo, hi;
        moving_span(splat_record, dv, middle, half_time, weight, cutoff2 > 0.0f, &lo, &hi);
        for (int lane = 0; lane < min(LANES, v_hi - first + 1); ++lane) {
            if (LANE(int, hi, lane) < LANE(int, lo, lane))
                continue;
            footprint_line line = footprint_at(splat_record, cell, first + lane, LANE(float, dv, lane), LANE(float, middle, lane),
                                               LANE(float, half_time, lane), LANE(float, weight, lane), path_limits);
            line.u_lo = LANE(int, lo, lane);
            line.u_hi = LANE(int, hi, lane);
            visit(visitor, line);
        }
    }
#else
    for (int v = v_lo; v <= v_hi; ++v)
        visit(visitor, footprint_alone(splat_record, cell, times, time_pitch, v, path_limits));
#endif
}
