/* The adjoint of rays_upright.cl. A ray counts for the voxels around it, by its distance from their centres. Along z, voxels
   and lines follow in the same order, so a vector of voxels sums over a few neighbouring lines. One work-item sums for a
   voxel, in a fixed order. LEAN: see ray_column.h. Twin: operators/twins/rays.py. */
#include "common/near_lines.h"

#define LINE_MARGIN 0.01f /* lines by which ranges are widened, more than their rounding; lines too far away weigh 0 */
#define PLANES ((ADJOINT_X > ADJOINT_Y ? ADJOINT_X : ADJOINT_Y) + LANES) /* planes of a box, in whole vectors */

/* Floor and ceil, for numbers that an int can hold. PoCL's functions take ten times as long. */
RAY_INLINE int whole_below(const float at)
{
    const int whole = (int)at;
    return whole - ((float)whole > at);
}
RAY_INLINE int whole_above(const float at)
{
    const int whole = (int)at;
    return whole + ((float)whole < at);
}

/* The detector columns (first, last) whose rays may touch a box of voxels. */
static inline int2 columns_of_box(__global const float *matrix, const int stride, const float4 first, const float4 last,
                                  const int u_first, const int u_stop)
{
    float least = MAXFLOAT, most = -MAXFLOAT;
    for (int corner = 0; corner < 8; ++corner) {
        const float x = corner & 1 ? last.x : first.x, y = corner & 2 ? last.y : first.y, z = corner & 4 ? last.z : first.z;
#define M(k) matrix[(size_t)(k) * stride]
        const float depth = M(8) * x + M(9) * y + M(10) * z + M(11);
        const float u = (M(0) * x + M(1) * y + M(2) * z + M(3)) / depth;
#undef M
        if (!(depth > 1e-3f)) /* the plane through the source cuts the box, which gives no bound */
            return (int2)(u_first, u_stop - 1);
        least = fmin(least, u);
        most = fmax(most, u);
    }
    return (int2)(max(u_first, whole_above(clamp(least - LINE_MARGIN, -1.0f, (float)u_stop))),
                  min(u_stop - 1, whole_below(clamp(most + LINE_MARGIN, -1.0f, (float)u_stop))));
}

/* The lines of a detector column, out of [first, stop), whose rays have the main axis x if `along_x`, else y. They are all,
   none, or those on one side of a border, which is found by bisection. */
RAY_INLINE int2 lines_along(__global const float *cell, const int u, const int first, const int stop, const int along_x)
{
    const int begins = is_along_x(cell, u, first) == along_x;
    if (!LEAN)
        return begins ? (int2)(first, stop) : (int2)(first, first);
    if (begins == (is_along_x(cell, u, stop - 1) == along_x))
        return begins ? (int2)(first, stop) : (int2)(first, first);
    int low = first, high = stop - 1; /* the border lies between them */
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if ((is_along_x(cell, u, middle) == along_x) == begins)
            low = middle;
        else
            high = middle;
    }
    return begins ? (int2)(first, high) : (int2)(high, stop);
}

/* The voxels of a box that a detector column's rays meet, plane by plane. */
typedef struct {
    int from[PLANES], stop[PLANES]; /* voxels [from, stop) along z that rays may touch; none if they miss the box */
    int first[PLANES];              /* the lowest column of voxels that a ray may touch */
    int most[PLANES];               /* most lines whose rays may touch a voxel */
    float ahead[PLANES];            /* distance from the source, in planes */
    float at[PLANES];               /* where the plane of the rays is at the source's height */
#if LEAN
    int is_between[PLANES];                      /* whether all rays pass between the first column and the next */
    /* Rounded, first_line + (per_voxel + bend z) z is the first line that may touch voxel z of the box. */
    float first_line[PLANES], per_voxel[PLANES], bend[PLANES];
#else
    float reach[PLANES];            /* distance of the farthest line that touches a voxel, in lines */
    float slope[PLANES], at_zero[PLANES], per_slope[PLANES]; /* voxels per line, the height of line 0, lines per voxel */
#endif
} planes_t;

RAY_INLINE vi whole_below_all(const vf at)
{
    const vi whole = V_INT(at);
    return whole - VI_PICK(0, 1, V_FLOAT(whole) > at);
}

/* Fills `planes` for the planes `between`, LANES at a time. sa: the plane at which the source is. The box has columns from
   b_first to b_stop, and nz voxels from z_first on. */
RAY_INLINE void meet_planes(const column_t r, const float sa, const int2 between, const int z_first, const int nz,
                            const int b_first, const int b_stop, planes_t *planes)
{
    for (int p = 0; p <= between.y - between.x; p += LANES) {
        const vf i = V_IOTA + (float)(between.x + p);
#if RAY_PARALLEL
        const vf ahead = (vf)(1.0f), sb = r.sb * i, sc = r.sc * i;
#else
        const vf ahead = i - sa, sb = (vf)(r.sb), sc = (vf)(r.sc);
#endif
        const vf h0 = fma((vf)(r.first), ahead, sc) - (float)z_first, h1 = fma((vf)(r.last), ahead, sc) - (float)z_first;
        const vf at = fma((vf)(r.across), ahead, sb);
        const vf at0 = LEAN ? fma((vf)(r.along * r.first), ahead, at) : at;
        const vf at1 = LEAN ? fma((vf)(r.along * r.last), ahead, at) : at;
        const vi misses = (max(at0, at1) <= (float)(b_first - 1)) | (min(at0, at1) >= (float)b_stop);
        const vi from = V_INT(min(max(min(h0, h1) - LINE_MARGIN, 0.0f), (float)nz));
        const vi above = whole_below_all(min(max(max(h0, h1) + LINE_MARGIN, -1.0f), (float)nz)) + 2;
        const vi stop = VI_PICK(min(above, nz), from, misses);
        const vi column = whole_below_all(max(min(at0, at1), (float)(b_first - 2)));
#if LEAN
        /* The largest number of lines per voxel. Beyond both ends, lines may be a little denser (bend). */
        const vf per = r.dense / max(fabs(ahead), LEAST_SLOPE);
        /* The lines at both ends of the voxels. In between a parabola approximates the line; `turn` bounds its error. */
        const vf over0 = V_FLOAT(from + z_first) - sc, over1 = V_FLOAT(stop + z_first) - sc;
        const vf turn0 = ahead * r.ez - over0 * r.ea, turn1 = ahead * r.ez - over1 * r.ea;
        const vf per_turns = 1.0f / (turn0 * turn1);
        const vf line0 = (over0 * r.da - ahead * r.dz) * turn1 * per_turns;
        const vf line1 = (over1 * r.da - ahead * r.dz) * turn0 * per_turns;
        const vf turn = 0.5f * (turn1 - turn0) * (turn1 + turn0) * per_turns;
        const vf reach = per * (1.0f + r.bend * per) + 0.15f * fabs(line1 - line0) * turn * turn + LINE_MARGIN;
        const vf bottom = V_FLOAT(from), top = V_FLOAT(stop);
        const vf per_height = 1.0f / max(top - bottom, 1.0f), per_voxel = (line1 - line0) * per_height;
        const vf bend = -turn * per_voxel * per_height; /* turn (line1 - line0) t (1 - t) is added at fraction t of the way */
        V_STORE(line0 - (per_voxel - bend * top) * bottom - reach + 1.0f, planes->first_line + p);
        V_STORE(per_voxel - bend * (bottom + top), planes->per_voxel + p);
        V_STORE(bend, planes->bend + p);
        VI_STORE(VI_PICK(0, 1, column == whole_below_all(min(max(at0, at1), (float)(b_stop + 1)))), planes->is_between + p);
#else
        const vf slope = r.ez * r.inv * ahead;
        const vf per_slope = 1.0f / V_PICK(LEAST_SLOPE, slope, fabs(slope) > LEAST_SLOPE);
        const vf reach = fabs(per_slope) + LINE_MARGIN;
        V_STORE(slope, planes->slope + p);
        V_STORE(per_slope, planes->per_slope + p);
        V_STORE(fma((vf)(r.dz * r.inv), ahead, sc), planes->at_zero + p);
        V_STORE(reach, planes->reach + p);
#endif
        VI_STORE(from, planes->from + p);
        VI_STORE(stop, planes->stop + p);
        VI_STORE(column, planes->first + p);
        VI_STORE(V_INT(min(2.0f * reach, (float)(r.v_stop - r.v_first - 1))) + 1, planes->most + p);
        V_STORE(ahead, planes->ahead + p);
        V_STORE(at, planes->at + p);
    }
}

/* Adds the part of a detector column on plane p to columns of voxels, which begin at voxel z_first. Column j is summed at
   sums + (j - b_first) step if b_first <= j < b_stop. Sums of other columns go to `beyond`: other work-items have them. */
RAY_INLINE void lines_onto(const column_t r, const planes_t *planes, const int p, const int z_first, const int b_first,
                           const int b_stop, float *sums, const int step, float *beyond)
{
    const int from = planes->from[p], stop = planes->stop[p], j = planes->first[p], most = planes->most[p];
    const float b_zero = planes->at[p];
#define COLUMN(j) ((j) < b_first || (j) >= b_stop ? beyond : sums + ((j) - b_first) * step)
#if LEAN
    const float ahead = planes->ahead[p], first_line = planes->first_line[p], per_voxel = planes->per_voxel[p];
    const float bend = planes->bend[p], start = r.sc - (float)z_first; /* the source's height in the box, in voxels */
    int j0 = j, j1 = j, next_look = planes->is_between[p] ? stop : from; /* up to next_look, rays pass between two columns */
    float *low = COLUMN(j), *high = COLUMN(j + 1), b_from = b_zero - (float)j;
    vf at = V_IOTA + (float)from;
    for (int z = from; z < stop; z += LANES, at += (float)LANES) {
        if (z >= next_look) {
            const float at0 = fma(r.along, (float)(z - 1) - start, b_zero);
            const float at1 = fma(r.along, (float)(z + LANES) - start, b_zero);
            j0 = whole_below(fmin(at0, at1));
            j1 = whole_below(fmax(at0, at1));
            low = COLUMN(j0);
            high = COLUMN(j0 + 1);
            b_from = b_zero - (float)j0;
            const float room = r.along > 0.0f ? (float)(j1 + 1) - at1 : at1 - (float)j0; /* distance to the next column */
            if (j0 == j1)
                next_look = z + (int)fmin(0.99f * room * r.per_along, (float)(ADJOINT_Z + LANES));
        }
        if (j1 < b_first - 1 || j0 >= b_stop)
            continue;
        const vf first = fma(at, fma(at, (vf)(bend), (vf)(per_voxel)), (vf)(first_line));
        const near_lines_t lines = near_lines(r, V_INT(min(max(first, (float)r.v_first), (float)(r.v_stop + 1))), most);
        if (!lines.some)
            continue;
        const vf under = start - at, b = fma(under, (vf)(-r.along), (vf)(b_from));
        if (j0 == j1)
            add_between(r, lines, most, ahead, under, b, low + z, high + z);
        else if (j1 == j0 + 1)
            add_around(r, lines, most, ahead, under, b - 1.0f, low + z, high + z, COLUMN(j0 + 2) + z);
        else
            for (int k = max(j0, b_first); k <= min(j1 + 1, b_stop - 1); ++k)
                add_across(r, lines, most, ahead, under, b - (float)(k - j0), COLUMN(k) + z);
    }
#else
    const float far_share = b_zero - (float)j, near_share = 1.0f - far_share;
    float *low = COLUMN(j), *high = COLUMN(j + 1);
    const float reach = planes->reach[p];
    const float slope = planes->slope[p], at_zero = planes->at_zero[p], per_slope = planes->per_slope[p];
    for (int z = from; z < stop; z += LANES) {
        const vf height = V_IOTA + (float)(z_first + z), below = at_zero - height;
        const vf before = min(max(below * -per_slope - reach, (float)(r.v_first - 1)), (float)r.v_stop);
        const near_lines_t lines = near_lines(r, V_INT(before + 1.0f), most);
        if (!lines.some)
            continue;
        vf sum = (vf)(0.0f), v = V_FLOAT(lines.first);
#ifdef V_LOOKUP
        if (lines.dense) {
            const vf v0 = V_LOAD(r.values + lines.base), v1 = V_LOAD(r.values + lines.base + LANES);
            vi place = lines.first - lines.base;
            for (int m = 0; m < most; ++m, v += 1.0f, place += 1) {
                const vf weight = max(1.0f - fabs(fma(v, (vf)(slope), below)), 0.0f);
                sum = fma(V_LOOKUP(v0, v1, place), weight, sum);
            }
            V_STORE(fma((vf)(near_share), sum, V_LOAD(low + z)), low + z);
            V_STORE(fma((vf)(far_share), sum, V_LOAD(high + z)), high + z);
            continue;
        }
        const int2 base = bases_of_halves(r, lines, most);
        if (base.x >= 0) { /* lines are denser than voxels */
            const vf v0 = V_LOAD(r.values + base.x), v1 = V_LOAD(r.values + base.x + LANES);
            const vf w0 = V_LOAD(r.values + base.y), w1 = V_LOAD(r.values + base.y + LANES);
            const vi is_upper = VI_IOTA >= LANES / 2;
            vi place = lines.first - VI_PICK(base.x, base.y, is_upper);
            for (int m = 0; m < most; ++m, v += 1.0f, place += 1) {
                const vf weight = max(1.0f - fabs(fma(v, (vf)(slope), below)), 0.0f);
                sum = fma(V_PICK(V_LOOKUP(v0, v1, place), V_LOOKUP(w0, w1, place), is_upper), weight, sum);
            }
        } else
#endif
        for (int m = 0; m < most; ++m, v += 1.0f) {
            const vf weight = max(1.0f - fabs(fma(v, (vf)(slope), below)), 0.0f);
            const vf value = GATHER(r.values, min(lines.first + m, r.v_stop - 1));
            sum = fma(V_PICK(0.0f, value, v < (float)r.v_stop), weight, sum);
        }
        V_STORE(fma((vf)(near_share), sum, V_LOAD(low + z)), low + z);
        V_STORE(fma((vf)(far_share), sum, V_LOAD(high + z)), high + z);
    }
#endif
}

/* A work-item sums for a box of ADJOINT_X by ADJOINT_Y by ADJOINT_Z voxels. */
__kernel void rays_upright_adjoint(
    __global const float *values,     /* slots, as split_slots writes them */
    const int slot_columns, const int slot_pitch, const long slots_floats,
    __global const float *cells, __global const int *slots, const int slot_count,
    __global const float *matrices, const int matrix_stride, /* (12, matrix_stride): rows give u d, v d, depth d of a voxel */
    const int4 shape, const int4 origin,
    const long4 to,                   /* voxel (z, y, x) is at to.x + y to.y + z to.z + x */
    const int add,
    __global float *volume)
{
    const int x_first = (int)get_global_id(0) * ADJOINT_X, y_first = (int)get_global_id(1) * ADJOINT_Y;
    const int z_first = (int)get_global_id(2) * ADJOINT_Z;
    if (x_first >= shape.x || y_first >= shape.y || z_first >= shape.z)
        return;
    const int nx = min(ADJOINT_X, shape.x - x_first), ny = min(ADJOINT_Y, shape.y - y_first);
    const int nz = min(ADJOINT_Z, shape.z - z_first);
    __global float *voxels = volume + to.x + z_first * to.z + y_first * to.y + x_first;
    float sums[ADJOINT_Y][ADJOINT_X][ADJOINT_Z + LANES] WIDE_ALIGNED; /* a vector may begin at any voxel */
    float beyond[ADJOINT_Z + LANES] WIDE_ALIGNED;
    for (int z = 0; z < ADJOINT_Z + LANES; ++z) {
        beyond[z] = 0.0f;
        for (int y = 0; y < ADJOINT_Y; ++y)
            for (int x = 0; x < ADJOINT_X; ++x)
                sums[y][x][z] = add && z < nz && y < ny && x < nx ? voxels[z * to.z + y * to.y + x] : 0.0f;
    }
    const float4 first = (float4)(origin.x + x_first - 1, origin.y + y_first - 1, origin.z + z_first - 1, 0);
    const float4 last = first + (float4)(nx + 1, ny + 1, nz + 1, 0);
    for (int n = 0; n < slot_count; ++n, slots += SLOT) {
        __global const float *cell = cells + (size_t)slots[SLOT_CELL] * RAY_CELL;
        const int2 seen = columns_of_box(matrices + slots[SLOT_CELL], matrix_stride, first, last, slots[SLOT_U],
                                         slots[SLOT_U_STOP]);
        for (int u = seen.x; u <= seen.y; ++u) {
            const long place = IMAGE_GUARD + ((long)n * slot_columns + u - slots[SLOT_U]) * slot_pitch - slots[SLOT_V];
            for (int along_x = 0; along_x < 2; ++along_x) {
                const int2 lines = lines_along(cell, u, slots[SLOT_V], slots[SLOT_V_STOP], along_x);
                if (lines.x >= lines.y)
                    continue;
                column_t r = column_of(cell, u, along_x, lines);
                r.values = values + place;
                r.slopes = r.values + slots_floats;
                r.is_cut = lines.y < slots[SLOT_V_STOP];
                r.last_start = slots[SLOT_V] + slot_pitch - 2 * LANES;
                const int b_first = along_x ? origin.y + y_first : origin.x + x_first;
                const int b_stop = b_first + (along_x ? ny : nx);
                const int a_first = along_x ? origin.x + x_first : origin.y + y_first;
                const int step = (along_x ? ADJOINT_X : 1) * (ADJOINT_Z + LANES); /* floats from one column to the next along b */
                const int step_a = (along_x ? 1 : ADJOINT_X) * (ADJOINT_Z + LANES); /* floats along a */
                const int2 planes = planes_between(cell, u, along_x, a_first, along_x ? nx : ny);
                planes_t met;
                meet_planes(r, cell[RAY_SOURCE + !along_x], planes, origin.z + z_first, nz, b_first, b_stop, &met);
                const float sc = r.sc;
                for (int p = 0; p <= planes.y - planes.x; ++p) {
                    r.sc = START_OF(sc, planes.x + p);
                    if (met.from[p] < met.stop[p])
                        lines_onto(r, &met, p, origin.z + z_first, b_first, b_stop,
                                   sums[0][0] + (planes.x + p - a_first) * step_a, step, beyond);
                }
            }
        }
    }
    for (int z = 0; z < nz; ++z)
        for (int y = 0; y < ny; ++y)
            for (int x = 0; x < nx; ++x)
                voxels[z * to.z + y * to.y + x] = sums[y][x][z];
}
