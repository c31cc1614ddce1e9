/* Projects every Gaussian from every time cell of a frame, in one launch. A work-item takes LANES Gaussians and loops over
   the cells. For each cell and Gaussian it writes a record (common/splat.h): the splat and the box of its pixels. At the end
   it writes the box around all splats of a Gaussian, from which binning.cl makes the lists of tiles.
   splat_prepare: a cell has one pose. With FIXED_CONIC this gives only the centre; another pose gives shape and depth.
   splat_prepare_moving: a cell is a segment of the frame's time, in which the centre moves from one end to the other
   (common/splat_moving.h). Twin: operators/twins/splat.py. */
#include "common/splat_view.h"
#include "common/splat_state.h"
#include "common/splat_moving.h"

#define COMMON_FIELDS 9 /* floats of a record before its six ints; a moving splat has more floats after them */
#if MOVING
#define FIELDS 12
#else
#define FIELDS COMMON_FIELDS
#define POSES (1 + FIXED_CONIC) /* poses of a cell: first of the shape, last of the centre */
#endif

/* Collects what both kinds of record have. fields (FIELDS, LANES); bounds (6, LANES): centre u v, u lo hi, v lo hi. */
ALWAYS_INLINE void collect(const splat_centre centre, const splat_view s, const pixel_box box, __private float *fields,
                           __private int *bounds)
{
    V_STORE(centre.u_rest, fields + REC_U_REST * LANES);
    V_STORE(centre.v_rest, fields + REC_V_REST * LANES);
    V_STORE(s.b1, fields + REC_B1 * LANES);
    V_STORE(s.b2, fields + REC_B2 * LANES);
    V_STORE(s.inv_kappa, fields + REC_INV_KAPPA * LANES);
    V_STORE(s.amplitude, fields + REC_AMP * LANES);
    VI_STORE(V_INT(centre.u_whole), bounds);
    VI_STORE(V_INT(centre.v_whole), bounds + LANES);
    VI_STORE(box.u_lo, bounds + 2 * LANES);
    VI_STORE(box.u_hi, bounds + 3 * LANES);
}

/* Writes the flags of LANES Gaussians, and the records of the visible ones. record_step: records from one Gaussian to the
   next. */
ALWAYS_INLINE void write_records(__private const float *fields, __private int *bounds, const pixel_box box,
                                 const size_t first_record, const size_t record_step, __global float *records,
                                 __global uchar *is_visible)
{
    VI_STORE(box.v_lo, bounds + 4 * LANES);
    VI_STORE(box.v_hi, bounds + 5 * LANES);
    for (int lane = 0; lane < LANES; ++lane) {
        const size_t at = first_record + lane * record_step;
        const int has_pixels = bounds[5 * LANES + lane] >= bounds[4 * LANES + lane];
        is_visible[at] = (uchar)has_pixels;
        if (!has_pixels)
            continue;
        __global float *splat_record = records + at * RECORD;
        __global int *record_as_int = (__global int *)splat_record;
        for (int f = 0; f < COMMON_FIELDS; ++f)
            splat_record[f] = fields[f * LANES + lane];
        for (int f = 0; f < 6; ++f)
            record_as_int[COMMON_FIELDS + f] = bounds[f * LANES + lane];
        for (int f = COMMON_FIELDS; f < FIELDS; ++f)
            splat_record[f + 6] = fields[f * LANES + lane];
    }
}

ALWAYS_INLINE void write_extents(const pixel_box extent, const int first, const int stride, __global int *extents)
{
    VI_STORE(extent.u_lo, extents + first);
    VI_STORE(extent.u_hi, extents + first + stride);
    VI_STORE(extent.v_lo, extents + first + 2 * stride);
    VI_STORE(extent.v_hi, extents + first + 3 * stride);
    VI_STORE((vi)(0), extents + first + 4 * stride);
    VI_STORE((vi)(0), extents + first + 5 * stride);
}

#if !MOVING
__kernel void splat_prepare(
    __global const float *gaussians,      /* (11, stride): mean, scale, quaternion, density */
    const int count, const int stride,
    __global const float *cells,          /* (C, CELL): the time cells of the frame */
    __global const coefficient *matrices, /* (C, POSES, 12): rows give u d, v d, depth d of a world point */
    __global const int *cell_lines,       /* (C, 2): the lines [first, stop) of a cell */
    const int cell_count,
    const int width,                      /* pixels of a line */
    const float cutoff2,                  /* squared Mahalanobis radius of the cutoff; 0 for none */
    __global float *records,              /* (stride, C, RECORD), unchanged where nothing is visible */
    __global uchar *is_visible,           /* (stride, C): 1 where a record was written */
    __global int *extents,                /* (6, stride): box of pixels in all cells: u lo, hi, v lo, hi, 0, 0 */
    __global const float *states,         /* DEFORMED: (S, STATE_ROWS, stride) */
    __global const int *cell_states)      /* (C,): the state of each cell */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    const gaussian reference = gaussian_load(gaussians, first, stride);
    const vi exists = V_INT((vf)(first) + V_IOTA) < count;
    pixel_box extent = empty_box();
    for (int c = 0; c < cell_count; ++c) {
        const gaussian g = gaussian_in_state(reference, states + STATE_AT(cell_states[c], first, stride), stride);
#if FIXED_CONIC
        const vf depth = project_centre(matrices + c * POSES * 12, g.mean).depth;
        const splat_centre centre = project_centre(matrices + (c * POSES + 1) * 12, g.mean);
        const splat_view s = view_splat(g, cells + c * CELL, depth);
        vi is_drawn = exists & s.is_drawn & (centre.depth > NEAREST);
#else
        const splat_centre centre = project_centre(matrices + c * 12, g.mean);
        const splat_view s = view_splat(g, cells + c * CELL, centre.depth);
        vi is_drawn = exists & s.is_drawn;
#endif
        pixel_box box = {(vi)(0), (vi)(width - 1), (vi)(cell_lines[2 * c]), (vi)(cell_lines[2 * c + 1] - 1)};
        if (cutoff2 > 0.0f) {
            const cutoff_ellipse e = ellipse_of(s, cutoff2);
            is_drawn &= e.is_bounded;
            narrow(centre.u_whole, centre.u_rest + e.u - e.half_u, centre.u_rest + e.u + e.half_u, &box.u_lo, &box.u_hi);
            narrow(centre.v_whole, centre.v_rest + e.v - e.half_v, centre.v_rest + e.v + e.half_v, &box.v_lo, &box.v_hi);
        }
        const vi visible = close_box(&box, is_drawn);
        enclose(&extent, box, visible);
        float fields[FIELDS * LANES];
        int bounds[6 * LANES];
        if (V_ANY(visible)) {
            V_STORE(s.l11, fields + REC_L11 * LANES);
            V_STORE(s.l12, fields + REC_L12 * LANES);
            V_STORE(s.l22, fields + REC_L22 * LANES);
            collect(centre, s, box, fields, bounds);
        }
        write_records(fields, bounds, box, (size_t)first * cell_count + c, cell_count, records, is_visible);
    }
    write_extents(extent, first, stride, extents);
}
#else

#define MOVING_FIELD(rec) ((rec) - 6) /* index in `fields`, which lacks the record's six ints */
#define POSES 3 /* poses of a cell: at the middle of the segment and at its two ends */

/* The path of the centre in a segment, from one end to the other. is_in_front: of the source, at both ends. */
typedef struct { vf u, v; vi is_in_front; } centre_path;

/* Finds the straight path, and shifts its middle so that its mean is that of the bent path. For t from -1/2 to 1/2, a bend
   s t^2 has the mean s/12, a sixth of the sum of its values at both ends. */
ALWAYS_INLINE centre_path path_of(__global const coefficient *end_matrices, const v3 means[2], splat_centre *middle)
{
    centre_path path;
    vf u[2], v[2];
    path.is_in_front = (vi)(-1);
    for (int end = 0; end < 2; ++end) {
        const splat_centre at = project_centre(end_matrices + 12 * end, means[end]);
        u[end] = (at.u_whole - middle->u_whole) + (at.u_rest - middle->u_rest);
        v[end] = (at.v_whole - middle->v_whole) + (at.v_rest - middle->v_rest);
        path.is_in_front &= at.depth > 0.0f;
    }
    path.u = u[1] - u[0];
    path.v = v[1] - v[0];
    const vf shift_u = (u[0] + u[1]) * (1.0f / 6.0f), shift_v = (v[0] + v[1]) * (1.0f / 6.0f);
    middle->u_rest += shift_u;
    middle->v_rest += shift_v;
    return path;
}

/* Narrows [lo, hi] to the pixels within `reach` of the path between the times `early` and `late`. */
ALWAYS_INLINE void narrow_to_path(const vf whole, const vf rest, const vf path, const vf reach, const vf early,
                                  const vf late, vi *lo, vi *hi)
{
    const vf from = path * early, to = path * late;
    narrow(whole, rest + min(from, to) - reach, rest + max(from, to) + reach, lo, hi);
}

/* The earliest and latest time at which any of the lines lo..hi is exposed. Lines open and close in order, so only the first
   and the last need be looked at. */
ALWAYS_INLINE void times_of_lines(__global const float *times, const int pitch, const vi lo, const vi hi, vf *early, vf *late)
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

/* The squared cutoff distance from the path, in standard deviations of the splat. It is `slack` times cutoff2, because Q
   changes along the path: 0.75 is the longest time from the middle, 1.1 and 1.2 are margins. */
ALWAYS_INLINE vf reach2_of(const splat_view s, const cutoff_ellipse e, const centre_path path, const vf speed, const float cutoff2)
{
    const vf tilt = fabs(s.b1) * (fabs(e.u) + e.half_u + 0.75f * fabs(path.u))
                    + fabs(s.b2) * (fabs(e.v) + e.half_v + 0.75f * fabs(path.v));
    const vf farthest = sqrt(cutoff2) + 0.75f * speed;
    const vf slack = (1.0f + 1.1f * tilt) * (1.0f + 1.1f * tilt)
                     / max(1.0f - 1.2f * farthest * farthest * s.inv_kappa, 0.1f);
    return cutoff2 * slack * 1.0001f;
}

__kernel void splat_prepare_moving(
    __global const float *gaussians, const int count, const int stride, /* arguments: see splat_prepare */
    __global const float *cells,
    __global const coefficient *matrices, /* (C, POSES, 12): matrices for the middle, start and end of a segment */
    __global const int *cell_lines, const int cell_count, const int width, const float cutoff2,
    __global float *records, __global uchar *is_visible, __global int *extents,
    __global const float *states,
    __global const int *cell_states,      /* (C, POSES): the state of the object at each pose */
    __global const float *line_times,     /* (C, TIME_ROWS, time_pitch): see common/splat_moving.h */
    const int time_pitch)
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    const gaussian reference = gaussian_load(gaussians, first, stride);
    const vi exists = V_INT((vf)(first) + V_IOTA) < count;
    pixel_box extent = empty_box();
    for (int c = 0; c < cell_count; ++c) {
        const gaussian g = gaussian_in_state(reference, states + STATE_AT(cell_states[c * POSES], first, stride), stride);
        const v3 end_means[2] = {MEAN_IN_STATE(g, states + STATE_AT(cell_states[c * POSES + 1], first, stride), stride),
                                 MEAN_IN_STATE(g, states + STATE_AT(cell_states[c * POSES + 2], first, stride), stride)};
        __global const coefficient *matrix = matrices + c * POSES * 12;
        splat_centre centre = project_centre(matrix, g.mean);
        const centre_path path = path_of(matrix + 12, end_means, &centre);
        const splat_view s = view_splat(g, cells + c * CELL, centre.depth);
        vi is_drawn = exists & s.is_drawn & path.is_in_front;
        /* The path in standard deviations of the splat: its length and direction. */
        const vf wide_u = s.l11 * path.u + s.l12 * path.v, wide_v = s.l22 * path.v;
        const vf speed = sqrt(wide_u * wide_u + wide_v * wide_v);
        const vi moves = speed > 1e-6f; /* a splat at rest may have any direction */
        const vf inv_speed = 1.0f / V_PICK(1.0f, speed, moves);
        const vf cosine = V_PICK(1.0f, wide_u * inv_speed, moves), sine = V_PICK(0.0f, wide_v * inv_speed, moves);
        vf reach2 = (vf)(MAXFLOAT);
        pixel_box box = {(vi)(0), (vi)(width - 1), (vi)(cell_lines[2 * c]), (vi)(cell_lines[2 * c + 1] - 1)};
        if (cutoff2 > 0.0f) {
            const cutoff_ellipse e = ellipse_of(s, cutoff2);
            is_drawn &= e.is_bounded;
            reach2 = reach2_of(s, e, path, speed, cutoff2);
            const vf root = sqrt(reach2 / (s.l11 * s.l11 * s.l22 * s.l22));
            const vf half_u = root * sqrt(s.l12 * s.l12 + s.l22 * s.l22) + 0.002f, half_v = root * s.l11 + 0.002f;
            vf early = (vf)(-0.75f), late = (vf)(0.75f); /* lines may be exposed a quarter of a segment beyond its ends */
            narrow_to_path(centre.v_whole, centre.v_rest, path.v, half_v, early, late, &box.v_lo, &box.v_hi);
            times_of_lines(TIMES_OF(c, line_times, time_pitch), time_pitch, box.v_lo, box.v_hi, &early, &late);
            narrow_to_path(centre.u_whole, centre.u_rest, path.u, half_u, early, late, &box.u_lo, &box.u_hi);
        }
        const vi visible = close_box(&box, is_drawn);
        enclose(&extent, box, visible);
        float fields[FIELDS * LANES];
        int bounds[6 * LANES];
        if (V_ANY(visible)) { /* a factor of S, turned so that the splat moves along its first axis */
            V_STORE(s.l11 * cosine, fields + REC_ALONG_U * LANES);
            V_STORE(s.l12 * cosine + s.l22 * sine, fields + REC_ALONG_V * LANES);
            V_STORE(s.l22 * cosine - s.l12 * sine, fields + REC_ACROSS_V * LANES);
            V_STORE(s.l11 * -sine, fields + MOVING_FIELD(REC_ACROSS_U) * LANES);
            V_STORE(speed, fields + MOVING_FIELD(REC_SPEED) * LANES);
            V_STORE(reach2, fields + MOVING_FIELD(REC_REACH2) * LANES);
            collect(centre, s, box, fields, bounds);
        }
        write_records(fields, bounds, box, (size_t)first * cell_count + c, cell_count, records, is_visible);
    }
    write_extents(extent, first, stride, extents);
}
#endif
