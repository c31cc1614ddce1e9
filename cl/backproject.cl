/* Voxel-driven backprojection with FDK's distance weight. Projections are interpolated bilinearly, and are zero outside.
   A work-item adds the views one after the other, so that bits do not depend on the number of launches. The volume may be a
   part of the grid (a brick), with its first voxel at `origin`. Twins: operators/twins/rays.py. */
#include "common/lanes.h"
#include "common/line_backprojection.h"

ALWAYS_INLINE vf lerp_of(const vf low, const vf high, const vf share) { return fma(share, high - low, low); }
/* Interpolates linearly at LANES places of a line in memory, with the weight wv of the next element. `fits`: two vectors from
   `least` on contain all places; if so, elements are looked up in them, else gathered. */
#ifdef V_LOOKUP
#define COLUMN_SAMPLES(column, least, place, wv, fits)                                                       \
    ((fits) ? lerp_lookup(V_LOAD((column) + (least)), V_LOAD((column) + (least) + LANES), (place) - (least), wv) \
            : lerp_of(GATHER((column), place), GATHER((column) + 1, place), wv))
ALWAYS_INLINE vf lerp_lookup(const vf lower, const vf upper, const vi place, const vf share)
{
    return lerp_of(V_LOOKUP(lower, upper, place), V_LOOKUP(lower, upper, place + 1), share);
}
#else
#define COLUMN_SAMPLES(column, least, place, wv, fits) lerp_of(GATHER((column), place), GATHER((column) + 1, place), wv)
#endif

__kernel void backproject(
    __global const float *projections, /* views of (guard, (rows, pitch)) */
    __global const float *matrices,    /* (views, 12): rows give u d, v d and the depth d of voxel x y z */
    __global const float *weights,     /* (views,): the factor of each view in the sum */
    const int views, const int rows, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    __global float *volume)
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= shape.x)
        return;
    const int y = (int)get_global_id(1) + origin.y, z = (int)get_global_id(2) + origin.z;
    const vf x = (vf)(first + origin.x) + V_IOTA;
    __global float *target = volume + IMAGE_GUARD
                             + (get_global_id(2) * shape.y + get_global_id(1)) * volume_pitch + first;
    const int next_row = rows > 1 ? image_pitch : 0, next = width > 1 ? 1 : 0;
    vf sum = V_LOAD(target);
    for (int f = 0; f < views; ++f) {
        __global const float *m = matrices + (size_t)f * 12;
        __global const float *image = projections + f * image_step + IMAGE_GUARD;
        const vf depth = m[8] * x + (m[9] * y + m[10] * z + m[11]);
        const vf inv = 1.0f / depth;
        const vf u = (m[0] * x + (m[1] * y + m[2] * z + m[3])) * inv;
        const vf v = (m[4] * x + (m[5] * y + m[6] * z + m[7])) * inv;
        const vi inside = IS_ON(u, width) & IS_ON(v, rows) & (depth > 0.0f);
        /* Positions outside are replaced before they are converted, because they may be too large for an integer. */
        const vf us = ONTO(V_PICK(0.0f, u, inside), width), vs = ONTO(V_PICK(0.0f, v, inside), rows);
        const vi column = min(V_INT(us), max(width - 2, 0)), row = min(V_INT(vs), max(rows - 2, 0));
        const vf wu = us - V_FLOAT(column), wv = vs - V_FLOAT(row);
        const vi at = row * image_pitch + column;
        const vf low = GATHER(image, at), high = GATHER(image + next, at);
        const vf below = GATHER(image + next_row, at), above = GATHER(image + next_row + next, at);
        const vf lower = low + wu * (high - low);
        const vf upper = below + wu * (above - below);
        sum += V_PICK(0.0f, BY_DISTANCE(weights[f], inv) * (lower + wv * (upper - lower)), inside);
    }
    /* A last vector may reach into the padding, which must stay zero. */
    V_STORE(V_PICK(0.0f, sum, V_IOTA < (float)(shape.x - first)), target);
}

#ifdef COLUMN_ROWS
/* The value at row v with EVEN_ROWS, where pixels are 0 in the first and last row, else 1. It needs no frame. */
#define EVEN_ROW(v) max(min(min(v, (float)(rows - 1) - (v)), 1.0f), 0.0f)
/* Along z, a column of voxels keeps its detector column and depth, and v is linear. So two detector columns are blended
   once for LANES voxels; or once for all voxels, if LANES voxels project to more rows than two vectors contain. Images are
   transposed: (columns, pitch), v along a row. The host chooses `block` such that its voxels project to at most COLUMN_ROWS
   rows. */
__kernel void backproject_upright(
    __global const float *projections, __global const float *matrices, __global const float *weights,
    const int views, const int rows, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    const int block, /* voxels along z per work-item, <= BLOCK_VOXELS */
    __global float *volume)
{
    if (get_global_id(0) >= shape.x)
        return;
    const int x = (int)get_global_id(0) + origin.x, y = (int)get_global_id(1) + origin.y;
    const int below = (int)get_global_id(2) * block, first = below + origin.z, count = min(block, shape.z - below);
    const size_t slice = (size_t)shape.y * volume_pitch;
    __global float *target = volume + IMAGE_GUARD + below * slice + get_global_id(1) * volume_pitch + get_global_id(0);
    float sum[BLOCK_VOXELS], blended[COLUMN_ROWS + 2 * LANES];
    for (int z = 0; z < count; ++z)
        sum[z] = target[z * slice];
    for (int f = 0; f < views; ++f) {
        __global const float *m = matrices + (size_t)f * 12;
        const float depth = m[8] * x + (m[9] * y + m[11]);
        const float inv = 1.0f / depth;
        const float place = (m[0] * x + (m[1] * y + m[3])) * inv, u = ONTO(place, width);
        if (!(IS_ON(place, width) && depth > 0.0f))
            continue;
        const float step = m[6] * inv, start = (m[4] * x + (m[5] * y + m[6] * first + m[7])) * inv;
        const float weight = BY_DISTANCE(weights[f], inv);
#ifdef EVEN_ROWS
        for (int z = 0; z < count; z += LANES)
            V_STORE(V_LOAD(sum + z) + weight * EVEN_ROW(start + step * (V_IOTA + (float)z)), sum + z);
        continue;
#endif
        const int column = min((int)u, max(width - 2, 0));
        const float high = weight * (u - column), low = weight - high;
        __global const float *a = projections + f * image_step + IMAGE_GUARD + (size_t)column * image_pitch;
        __global const float *b = a + (width > 1 ? image_pitch : 0);
#ifdef V_LOOKUP
        if (fabs(step) * (LANES - 1) < (float)(2 * LANES - 3)) { /* two vectors contain the rows of LANES voxels */
            for (int z = 0; z < count; z += LANES) {
                const vf place = start + step * (V_IOTA + (float)z), v = ONTO(place, rows);
                const vi inside = fabs(place - v) <= ROUNDING;
                if (!V_ANY(inside))
                    continue;
                const vi row = V_INT(v);
                const int least = clamp((int)fmin(V_FIRST(v), V_LAST(v)), 0, max(rows + 1 - 2 * LANES, 0));
                const vf lower = low * V_LOAD(a + least) + high * V_LOAD(b + least);
                const vf upper = low * V_LOAD(a + least + LANES) + high * V_LOAD(b + least + LANES);
                const vf here = V_LOOKUP(lower, upper, row - least), next = V_LOOKUP(lower, upper, row - least + 1);
                const vf value = here + (v - V_FLOAT(row)) * (next - here);
                V_STORE(V_LOAD(sum + z) + V_PICK(0.0f, value, inside), sum + z);
            }
            continue;
        }
#endif
        /* z at the first and last row */
        const float at_low = (-ROUNDING - start) / step, at_high = ((float)(rows - 1) + ROUNDING - start) / step;
        const int z_start = (int)clamp(ceil(fmin(at_low, at_high)), 0.0f, (float)count);
        const int z_stop = (int)clamp(floor(fmax(at_low, at_high)), -1.0f, (float)(count - 1)) + 1;
        if (z_start >= z_stop)
            continue;
        const float v_start = start + step * z_start, v_last = start + step * (z_stop - 1);
        const int base = clamp((int)fmin(v_start, v_last), 0, max(rows - 2, 0));
        const int stop = min((int)fmax(v_start, v_last), rows - 1) + 2; /* row `rows` is padding, with zeros */
        for (int v = base; v < stop; v += LANES)
            V_STORE(low * V_LOAD(a + v) + high * V_LOAD(b + v), blended + (v - base));
        if (stop > rows)
            blended[rows - base] = blended[rows - 1 - base]; /* for v beyond the last row by rounding */
        const float shift = start - base;
        for (int z = z_start; z < z_stop; ++z) {
            const float v = fmax(shift + step * z, 0.0f);
            const int row = (int)v;
            sum[z] += blended[row] + (v - row) * (blended[row + 1] - blended[row]);
        }
    }
    for (int z = 0; z < count; ++z)
        target[z * slice] = sum[z];
}

#define EVEN_DEPTH 0.02f   /* 1/depth counts as nearly linear along a block if the depth changes by at most this fraction */
#define VOXEL_MARGIN 0.01f /* where a column of voxels enters or leaves a view is rounded by less than this, in voxels */

/* Narrows the range `within` (low, high) of z to where start + per_z z >= 0. */
ALWAYS_INLINE float2 narrowed(const float2 within, const float start, const float per_z)
{
    const float root = -start / per_z;
    if (per_z == 0.0f)
        return start < 0.0f ? (float2)(MAXFLOAT, -MAXFLOAT) : within;
    return per_z > 0.0f ? (float2)(fmax(within.x, root), within.y) : (float2)(within.x, fmin(within.y, root));
}

/* Narrows the range `within` of z to where u is on pixels 0 to `most`, by IS_ON. u · depth and depth are linear along z. */
ALWAYS_INLINE float2 narrowed_to(
    const float2 within, const float most, const float u, const float u_per_z, const float depth, const float depth_per_z)
{
    const float2 low = narrowed(within, fma(ROUNDING, depth, u), fma(ROUNDING, depth_per_z, u_per_z));
    return narrowed(low, fma(most + ROUNDING, depth, -u), fma(most + ROUNDING, depth_per_z, -u_per_z));
}

/* As backproject_upright, for the slightly rolled panel of a calibrated scan: along z also the detector column and the depth
   change a little. LANES voxels project between two detector columns, or pass from one to the next. */
__kernel void backproject_leaning(
    __global const float *projections, __global const float *matrices, __global const float *weights,
    const int views, const int rows, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    const int block, __global float *volume)
{
    if (get_global_id(0) >= shape.x)
        return;
    const int x = (int)get_global_id(0) + origin.x, y = (int)get_global_id(1) + origin.y;
    const int below = (int)get_global_id(2) * block, first = below + origin.z, count = min(block, shape.z - below);
    const size_t slice = (size_t)shape.y * volume_pitch;
    __global float *target = volume + IMAGE_GUARD + below * slice + get_global_id(1) * volume_pitch + get_global_id(0);
    const float u_most = (float)(width - 1), v_most = (float)(rows - 1);
    const int last_column = max(width - 2, 0), last_row = max(rows - 2, 0);
    float sum[BLOCK_VOXELS + LANES];
    for (int z = 0; z < count; ++z)
        sum[z] = target[z * slice];
    for (int f = 0; f < views; ++f) {
        __global const float *m = matrices + (size_t)f * 12;
        const float depth_0 = m[8] * x + (m[9] * y + m[10] * first + m[11]);
        const float u_0 = m[0] * x + (m[1] * y + m[2] * first + m[3]), v_0 = m[4] * x + (m[5] * y + m[6] * first + m[7]);
        float2 seen = narrowed_to((float2)(-1.0f, (float)(count + LANES)), u_most, u_0, m[2], depth_0, m[10]);
        seen = narrowed_to(seen, v_most, v_0, m[6], depth_0, m[10]);
        if (seen.x > seen.y + 2.0f * VOXEL_MARGIN)
            continue;
        const int start = (int)clamp(seen.x - VOXEL_MARGIN, 0.0f, (float)count) / LANES * LANES;
        const int stop = (int)clamp(seen.y + VOXEL_MARGIN + 1.0f, 0.0f, (float)count);
        __global const float *image = projections + f * image_step + IMAGE_GUARD;
        /* If the depth hardly changes, 1/depth is nearly linear, and a Newton step leaves a relative error of 1e-8. */
        const float inv_0 = 1.0f / depth_0, per_z = (1.0f / fma((float)count, m[10], depth_0) - inv_0) / (float)count;
        const int is_even = fabs((float)count * m[10]) <= EVEN_DEPTH * depth_0;
        const int rises = m[2] * depth_0 > u_0 * m[10]; /* whether u rises along z */
        int own = 0;         /* vectors that end before voxel `until` project between detector columns own and own + 1 */
        float until = -1.0f;
        for (int k = start; k < stop; k += LANES) {
            const float end = (float)(k + LANES - 1);
            const vf z = V_IOTA + (float)k, depth = fma(z, (vf)(m[10]), (vf)(depth_0));
            vf inv;
            if (is_even) {
                const vf guess = fma(z, (vf)(per_z), (vf)(inv_0));
                inv = fma(guess, fma(-depth, guess, (vf)(1.0f)), guess);
            } else
                inv = 1.0f / depth;
            const vf place = fma(z, (vf)(m[2]), (vf)(u_0)) * inv, v = fma(z, (vf)(m[6]), (vf)(v_0)) * inv;
            const int is_inside = (float)k >= seen.x + VOXEL_MARGIN && end <= seen.y - VOXEL_MARGIN;
            vi inside = (vi)(0);
            vf u = place, vs = v;
            if (!is_inside) {
                inside = IS_ON(u, width) & IS_ON(v, rows) & (inv > 0.0f);
                u = ONTO(place, width);
                vs = V_PICK(V_PICK(0.0f, v_most, v > v_most), v, (v >= 0.0f) & (v <= v_most));
            }
#ifdef EVEN_ROWS
            vf value = EVEN_ROW(vs);
#else
            const vi row = min(V_INT(vs), last_row);
            const vf wv = vs - V_FLOAT(row);
            int column = own, to = own;
            if (LANES == 1 || end >= until) { /* the test of LANES keeps a compiler from making vectors itself */
                const float u0 = clamp(V_FIRST(u), 0.0f, u_most), u1 = clamp(V_LAST(u), 0.0f, u_most);
                own = min((int)u1, last_column);
                column = min(own, (int)u0);
                to = max(own, min((int)u0, last_column));
                const float border = (float)(own + rises);
                until = fma(-border, depth_0, u_0) / fma(border, m[10], -m[2]) - VOXEL_MARGIN;
            }
            const int v0 = V_FIRST(row), v1 = V_LAST(row), fits = abs(v1 - v0) <= 2 * LANES - 2;
            const int least = min(min(v0, v1), max(rows + 1 - 2 * LANES, 0));
            __global const float *a = image + (size_t)column * image_pitch, *b = a + (width > 1 ? image_pitch : 0);
            const vf low = COLUMN_SAMPLES(a, least, row, wv, fits);
            vf value, high = COLUMN_SAMPLES(b, least, row, wv, fits);
            if (column == to)
                value = fma(u - (float)column, high - low, low);
            else {
                value = max(1.0f - fabs(u - (float)column), 0.0f) * low;
                value += max(1.0f - fabs(u - (float)(column + 1)), 0.0f) * high;
                for (int i = column + 2; i <= to + 1; ++i) {
                    b += image_pitch;
                    high = COLUMN_SAMPLES(b, least, row, wv, fits);
                    value += max(1.0f - fabs(u - (float)i), 0.0f) * high;
                }
            }
#endif
            value *= BY_DISTANCE(weights[f], inv);
            V_STORE(V_LOAD(sum + k) + (is_inside ? value : V_PICK(0.0f, value, inside)), sum + k);
        }
    }
    for (int z = 0; z < count; ++z)
        target[z * slice] = sum[z];
}
#endif

/* Interpolates a line of pixels at u; 0 outside the line. */
ALWAYS_INLINE vf samples_of(__global const float *line, const vf u, const int width)
{
    const vf most = (vf)(width - 1);
    const vi inside = IS_ON(u, width);
    const vf us = V_PICK(V_PICK(0.0f, most, u > most), u, (u >= 0.0f) & (u <= most));
    const vi place = min(V_INT(us), max(width - 2, 0));
    const int p0 = V_FIRST(place), p1 = V_LAST(place), fits = abs(p1 - p0) <= 2 * LANES - 2;
    const int least = min(min(p0, p1), max(width + 1 - 2 * LANES, 0));
    return V_PICK(0.0f, COLUMN_SAMPLES(line, least, place, us - V_FLOAT(place), fits), inside);
}

/* A vector of voxels is parallel to the lines, so that one or two lines see all of it: along z if ALONG_Z (lines are
   detector columns), else along x. */
#ifdef ALONG_Z
#define STRETCHED(begin) (begin).z *= LANES
#define X_OF(first) ((vf)((first).x))
#define Z_OF(first) ((vf)((first).z) + V_IOTA)
#define TO_LAST(count) (float4)(0.0f, 0.0f, (float)((count) - 1), 0.0f)
#else
#define STRETCHED(begin) (begin).x *= LANES
#define X_OF(first) ((vf)((first).x) + V_IOTA)
#define Z_OF(first) ((vf)((first).z))
#define TO_LAST(count) (float4)((float)((count) - 1), 0.0f, 0.0f, 0.0f)
#endif
#define PROJECTED(m, row) ((m)[4 * (row)] * x + (m)[4 * (row) + 2] * z + ((m)[4 * (row) + 1] * y + (m)[4 * (row) + 3]))

__kernel void backproject_lines(
    __global const float *projections, /* views of (guard, (lines, pitch)) */
    __global const float *matrices,    /* (views, lines, 12): as in backproject, for the pose of each line */
    __global const float *weights,     /* (views,): the factor of each view in the sum */
    const int views, const int lines, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    const int filtered_across, /* 1 if the ramp filter ran across lines: the panel was read column by column */
    __global float *volume)
{
    int4 begin = (int4)(get_global_id(0), get_global_id(1), get_global_id(2), 0);
    STRETCHED(begin);
    if (begin.x >= shape.x)
        return;
#ifdef ALONG_Z
    const int count = min(LANES, shape.z - begin.z);
    const size_t apart = (size_t)shape.y * volume_pitch;
#else
    const int count = min(LANES, shape.x - begin.x);
    const size_t apart = 1;
#endif
    __global float *target = volume + IMAGE_GUARD + ((size_t)begin.z * shape.y + begin.y) * volume_pitch + begin.x;
    float sums[LANES] = {0};
    for (int k = 0; k < count; ++k)
        sums[k] = target[k * apart];
    vf sum = V_LOAD(sums);
    const int4 first = begin + origin;
    const float4 a = convert_float4(first), b = a + TO_LAST(count); /* the first and the last voxel of the vector */
    const vf x = X_OF(first), z = Z_OF(first);
    const float y = (float)first.y;
    const int last = max(lines - 2, 0), step = lines > 1 ? 12 : 0, next_line = lines > 1 ? image_pitch : 0;
    for (int f = 0; f < views; ++f) {
        __global const float *table = matrices + (size_t)f * lines * 12;
        __global const float *image = projections + f * image_step + IMAGE_GUARD;
        float t, speed, depth0, next0, depth1, next1;
        const int of_a = line_seeing(table, lines, last / 2, a.x, a.y, a.z, &t, &speed, &depth0, &next0);
        const int of_b = line_seeing(table, lines, of_a, b.x, b.y, b.z, &t, &speed, &depth1, &next1);
        const int is_in_front = depth0 > 0.0f && next0 > 0.0f && depth1 > 0.0f && next1 > 0.0f;
        const int from = is_in_front ? min(of_a, of_b) : 0, to = is_in_front ? max(of_a, of_b) : last;
        vi waits = V_IOTA < (float)count; /* lanes whose line is still to be found */
        for (int line = from; line <= to && V_ANY(waits); ++line) {
            __global const float *m = table + (size_t)line * 12, *n = m + step, *pixels = image + (size_t)line * image_pitch;
            const vf depth = PROJECTED(m, 2), next_depth = PROJECTED(n, 2);
            const vf inv = 1.0f / depth, next_inv = 1.0f / next_depth;
            const vf v = PROJECTED(m, 1) * inv, next_v = PROJECTED(n, 1) * next_inv;
            const vf rate = fmax(1.0f - (next_v - v), LEAST_SPEED), on = (v - (float)line) / rate;
            const vi served = waits & (on < (vf)(line == to ? MAXFLOAT : 1.0f));
            waits &= ~served;
            const vi is_open = served & (depth > 0.0f) & (next_depth > 0.0f) & IS_ON(on + (float)line, lines);
            if (!V_ANY(is_open))
                continue;
            const vf here = samples_of(pixels, PROJECTED(m, 0) * inv, width);
            const vf there = samples_of(pixels + next_line, PROJECTED(n, 0) * next_inv, width);
            const vf at = ONTO(on + (float)line, lines) - (float)line, between = depth + at * (next_depth - depth);
            const vf value = BY_LINE(weights[f], between, filtered_across ? rate * rate : rate) * (here + at * (there - here));
            sum += V_PICK(0.0f, value, is_open);
        }
    }
    V_STORE(sum, sums);
    for (int k = 0; k < count; ++k)
        target[k * apart] = sums[k];
}
