/* The projector of rays.cl for detector columns nearly parallel to the volume's z. The rays to such a column then share most
   of their work. Volumes are transposed, with z along a row, so samples of neighbouring lines are side by side in memory.
   Samples and weights are those of rays.cl. A work-item takes a detector column of one pose.
   LEAN 0: columns are parallel to z. All rays to a column meet a plane of voxels at the same x (or y), so two columns of
   voxels are blended once for all of them. LEAN 1: this x changes a little from line to line.
   Twin: operators/twins/rays.py. */
#include "common/ray_column.h"

#define TURN 16 /* side (x and z) of the tile that a work-item transposes, in voxels */

/* Transposes a volume, so that z is along rows. Voxel (z, y, x) is at from.x + y from.y + z from.z + x. The result is a guard,
   then (y, x, pitch), with a border of BORDER voxels in y and x that the kernel does not write: it must be zero. */
__kernel void turn_upright(
    __global const float *volume, const long4 from, const int4 shape, const int column_pitch,
    __global float *columns)
{
    const int x0 = (int)get_global_id(0) * TURN, y = (int)get_global_id(1), z0 = (int)get_global_id(2) * TURN;
    if (x0 >= shape.x || z0 >= shape.z)
        return;
    __global const float *voxels = volume + from.x + y * from.y + z0 * from.z + x0;
    __global float *to = columns + IMAGE_GUARD
                         + ((y + BORDER) * (size_t)(shape.x + 2 * BORDER) + x0 + BORDER) * column_pitch + z0;
    const int wide = min(TURN, shape.x - x0), high = min(TURN, shape.z - z0);
    float tile[TURN][TURN];
    for (int z = 0; z < high; ++z)
        if (wide == TURN)
            vstore16(vload16(0, voxels + z * from.z), 0, tile[z]);
        else
            for (int x = 0; x < wide; ++x)
                tile[z][x] = voxels[z * from.z + x];
    for (int x = 0; x < wide; ++x)
        for (int z = 0; z < high; ++z)
            to[(size_t)x * column_pitch + z] = tile[z][x];
}

/* The planes of voxels across the main axis a of a detector column's rays. On plane i a ray is at b = s_b + g_b (i - s_a). */
typedef struct {
    float sa, sb, sc;
    int na, nb, a_first, b_first, b_last, c_first, c_last;
    size_t stride_a, stride_b; /* floats from a voxel to the next along a and along b, in the transposed volume */
} planes_t;

RAY_INLINE planes_t planes_of(__global const float *cell, const int along_x, const int4 shape, const int4 origin,
                              const int column_pitch)
{
    planes_t r;
    const size_t row = (size_t)column_pitch * (shape.x + 2 * BORDER);
    r.sa = cell[RAY_SOURCE + !along_x];
    r.sb = cell[RAY_SOURCE + along_x];
    r.sc = cell[RAY_SOURCE + 2];
    r.na = along_x ? shape.x : shape.y;
    r.nb = along_x ? shape.y : shape.x;
    r.a_first = along_x ? origin.x : origin.y;
    r.b_first = along_x ? origin.y : origin.x;
    r.b_last = r.b_first + r.nb - 1;
    r.c_first = origin.z;
    r.c_last = origin.z + shape.z - 1;
    r.stride_a = along_x ? (size_t)column_pitch : row;
    r.stride_b = along_x ? row : (size_t)column_pitch;
    return r;
}

/* Returns the planes of planes_of for plane i. In a parallel beam every plane has another source (common/ray.h); in a cone
   beam nothing changes. */
RAY_INLINE planes_t planes_from(planes_t r, const int i)
{
#if RAY_PARALLEL
    r.sa = (float)i - AHEAD_OF(r.sa, i);
    r.sb = START_OF(r.sb, i);
    r.sc = START_OF(r.sc, i);
#endif
    return r;
}

/* The voxel at or below a position, which has been clamped to a box, and at most `last`. */
RAY_INLINE int voxel_below(const float at, const int last) { return min((int)(at + 1.0f) - 1, last); }

/* Whether two vectors contain the voxels that LANES lines meet along c, with slopes from g[0] to g[LANES - 1]. */
#ifdef V_LOOKUP
#define FIT_TWO_VECTORS(g, ahead) (fabs(((g)[LANES - 1] - (g)[0]) * (ahead)) < (float)(2 * LANES - 3))
#endif

/* Interpolates for LANES lines between voxels z and z + 1 of a column, with weight wc of the second. low, high: two vectors
   of the column. place: z, counted from their first voxel. */
#define BETWEEN(low, high, place, wc) \
    fma((wc), V_LOOKUP(low, high, (place) + 1) - V_LOOKUP(low, high, place), V_LOOKUP(low, high, place))

#if LEAN
/* Adds to p the samples of `count` lines on plane i. plane: where its voxel with b = c = 0 in the grid would be. */
RAY_INLINE void sample_plane(__global const float *plane, const planes_t r, const int i, const float *gb, const float *gc,
                             const int count, float *p, float *blended)
{
    const float ahead = (float)i - r.sa, lowest = (float)(r.b_first - 1), highest = (float)(r.b_last + 1);
    const int last = (count + LANES - 1) / LANES * LANES - 1; /* where the last vector ends, beyond the last line */
    const float b0 = fma(gb[0], ahead, r.sb), b1 = fma(gb[last], ahead, r.sb);
    if (fmax(b0, b1) <= lowest || fmin(b0, b1) >= highest)
        return;
#ifdef V_LOOKUP
    const int is_dense = FIT_TWO_VECTORS(gc, ahead) && FIT_TWO_VECTORS(gc + last + 1 - LANES, ahead);
    const int top = max(r.c_last + 2 - 2 * LANES, r.c_first - 1);
    /* b rises or falls from line to line. So all lines of a vector are between the same two columns of voxels if its last
       line is, and the line before its first. */
    int j = voxel_below(clamp(b0, lowest, highest), r.b_last), is_between = is_dense && b0 >= lowest && b0 < highest;
#endif
    for (int k = 0; k < count; k += LANES) {
#ifdef V_LOOKUP
        const float end = fma(gb[k + LANES - 1], ahead, r.sb);
        if (is_between && end >= (float)j && end < (float)(j + 1)) {
            __global const float *near = plane + j * (long)r.stride_b, *far = near + r.stride_b;
            vf wc;
            const vi z = sample_at(V_LOAD(gc + k), r.sc, ahead, r.c_first, r.c_last, &wc);
            const int base = min(min(V_FIRST(z), V_LAST(z)), top);
            const vi own = z - base;
            const vf first = BETWEEN(V_LOAD(near + base), V_LOAD(near + base + LANES), own, wc);
            const vf second = BETWEEN(V_LOAD(far + base), V_LOAD(far + base + LANES), own, wc);
            const vf wb = fma(V_LOAD(gb + k), (vf)(ahead), (vf)(r.sb - (float)j));
            V_STORE(V_LOAD(p + k) + fma(wb, second - first, first), p + k);
            continue;
        }
        j = voxel_below(clamp(end, lowest, highest), r.b_last);
        is_between = is_dense && end >= lowest && end < highest;
#endif
        const float from = clamp(fma(gb[k], ahead, r.sb), lowest, highest);
        const float to = clamp(fma(gb[k + LANES - 1], ahead, r.sb), lowest, highest);
        const int j0 = voxel_below(fmin(from, to), r.b_last), j1 = voxel_below(fmax(from, to), r.b_last);
        const vf b = min(max(fma(V_LOAD(gb + k), (vf)(ahead), (vf)(r.sb)), lowest), highest);
        vf wc, sum = V_LOAD(p + k);
        const vi z = sample_at(V_LOAD(gc + k), r.sc, ahead, r.c_first, r.c_last, &wc);
#ifdef V_LOOKUP
        if (is_dense) {
            const int base = min(min(V_FIRST(z), V_LAST(z)), top);
            const vi own = z - base;
            __global const float *near = plane + j0 * (long)r.stride_b + base, *far = near + r.stride_b;
            vf first = BETWEEN(V_LOAD(near), V_LOAD(near + LANES), own, wc);
            vf second = BETWEEN(V_LOAD(far), V_LOAD(far + LANES), own, wc);
            if (j0 == j1)
                sum += fma(b - (float)j0, second - first, first);
            else { /* lines pass from one column of voxels to the next */
                sum += max(1.0f - fabs(b - (float)j0), 0.0f) * first + max(1.0f - fabs(b - (float)(j0 + 1)), 0.0f) * second;
                for (int j = j0 + 2; j <= j1 + 1; ++j) {
                    far += r.stride_b;
                    second = BETWEEN(V_LOAD(far), V_LOAD(far + LANES), own, wc);
                    sum += max(1.0f - fabs(b - (float)j), 0.0f) * second;
                }
            }
            V_STORE(sum, p + k);
            continue;
        }
#endif
        for (int j = j0; j <= j1 + 1; ++j) {
            __global const float *column = plane + j * (long)r.stride_b;
            const vf a = GATHER(column, z), above = GATHER(column + 1, z);
            sum += max(1.0f - fabs(b - (float)j), 0.0f) * fma(wc, above - a, a);
        }
        V_STORE(sum, p + k);
    }
}
#else
/* Adds to p the samples of `count` lines on plane i. plane: where its voxel with b = c = 0 in the grid would be. gb: its
   first element is the slope of all lines. */
RAY_INLINE void sample_plane(__global const float *plane, const planes_t r, const int i, const float *gb, const float *gc,
                             const int count, float *p, float *blended)
{
    const float ahead = (float)i - r.sa, at = fma(gb[0], ahead, r.sb);
    if (at <= (float)(r.b_first - 1) || at >= (float)(r.b_last + 1))
        return;
    const int j = voxel_below(at, r.b_last);
    const float wb = at - (float)j;
    __global const float *near = plane + j * (long)r.stride_b, *far = near + r.stride_b;
#ifdef V_LOOKUP
    if (FIT_TWO_VECTORS(gc, ahead)) {
        const int top = max(r.c_last + 2 - 2 * LANES, r.c_first - 1);
        for (int k = 0; k < count; k += LANES) {
            vf wc;
            const vi z = sample_at(V_LOAD(gc + k), r.sc, ahead, r.c_first, r.c_last, &wc);
            const int base = min(min(V_FIRST(z), V_LAST(z)), top);
            const vf low = V_LOAD(near + base), high = V_LOAD(near + base + LANES);
            const vf lower = fma((vf)(wb), V_LOAD(far + base) - low, low);
            const vf upper = fma((vf)(wb), V_LOAD(far + base + LANES) - high, high);
            V_STORE(V_LOAD(p + k) + BETWEEN(lower, upper, z - base, wc), p + k);
        }
        return;
    }
#endif
    /* The voxels that the lines' samples need, from the one below the lowest to the one above the highest. */
    const float z0 = fma(gc[0], ahead, r.sc), z1 = fma(gc[count - 1], ahead, r.sc);
    const int base = voxel_below(clamp(fmin(z0, z1), (float)(r.c_first - 1), (float)(r.c_last + 1)), r.c_last);
    const int stop = voxel_below(clamp(fmax(z0, z1), (float)(r.c_first - 1), (float)(r.c_last + 1)), r.c_last) + 2;
    for (int k = 0; k < stop - base; k += LANES) {
        const vf a = V_LOAD(near + base + k);
        V_STORE(fma((vf)(wb), V_LOAD(far + base + k) - a, a), blended + k);
    }
    for (int k = 0; k < count; k += LANES) {
        vf wc;
        /* Clamped, because lanes beyond the last line may point outside of the blended voxels. */
        const vi z = sample_at(V_LOAD(gc + k), r.sc, ahead, r.c_first, r.c_last, &wc) - base;
        const vi own = min(max(z, 0), stop - base - 2);
        const vf a = GATHER(blended, own), b = GATHER(blended + 1, own);
        V_STORE(V_LOAD(p + k) + fma(wc, b - a, a), p + k);
    }
}
#endif

__kernel void rays_upright(
    __global const float *columns,    /* the whole volume, transposed by turn_upright */
    __global const float *cells,      /* (C, RAY_CELL): one per pose */
    __global const int *slots,        /* (S, SLOT): poses, and the lines and columns that they serve */
    const int4 shape, const int4 origin, const int column_pitch, const float4 pitch_mm,
    const int block,                  /* lines per work-item, <= UPRIGHT_LINES */
    const long4 to,                   /* a result is at to.x + u to.y + v to.z + slot to.w, counted in the slot */
    __global float *image)
{
    __global const int *slot = slots + SLOT * (size_t)get_global_id(0);
    const int u = slot[SLOT_U] + (int)get_global_id(1), start = slot[SLOT_V] + (int)get_global_id(2) * block;
    const int count = min(block, slot[SLOT_V_STOP] - start);
    if (u >= slot[SLOT_U_STOP] || count <= 0)
        return;
    __global const float *cell = cells + (size_t)slot[SLOT_CELL] * RAY_CELL;
    /* With room for a vector that begins at the last line or voxel. */
    float total[UPRIGHT_LINES + LANES], p[UPRIGHT_LINES + LANES], gc[UPRIGHT_LINES + LANES], gb[UPRIGHT_LINES + LANES];
    float blended[UPRIGHT_VOXELS + 2 * LANES];
    const int first_along_x = is_along_x(cell, u, start), last_along_x = is_along_x(cell, u, start + count - 1);
    for (int turn = 0; turn < 1 + (first_along_x != last_along_x); ++turn) { /* a column that leans may have both main axes */
        const int along_x = turn ? last_along_x : first_along_x;
        const planes_t r = planes_of(cell, along_x, shape, origin, column_pitch);
        for (int k = 0; k < count; k += LANES) {
            const column_rays_t d = column_rays(cell, u, start + k);
            const vf inv = 1.0f / (along_x ? d.x : d.y);
            V_STORE((along_x ? d.y : d.x) * inv, gb + k);
            V_STORE(d.z * inv, gc + k);
            V_STORE((vf)(0.0f), p + k);
        }
        const int last = (count + LANES - 1) / LANES * LANES - 1;
        const int2 planes = planes_within(planes_between(cell, u, along_x, r.a_first, r.na), r.sa, r.sb, gb[0], gb[last],
                                          (float)(r.b_first - 1), (float)(r.b_last + 1));
        __global const float *plane = columns + IMAGE_GUARD + (long)(planes.x - r.a_first + BORDER) * r.stride_a
                                      - (long)(r.b_first - BORDER) * r.stride_b - r.c_first;
        for (int i = planes.x; i <= planes.y; ++i, plane += r.stride_a)
            sample_plane(plane, planes_from(r, i), i, gb, gc, count, p, blended);
        for (int k = 0; k < count; k += LANES) {
            const column_rays_t d = column_rays(cell, u, start + k);
            const vf part = V_LOAD(p + k) * column_steps_mm(cell, d, pitch_mm);
            V_STORE(V_PICK(turn ? V_LOAD(total + k) : (vf)(0.0f), part, column_along_x(cell, d) == along_x),
                    total + k);
        }
    }
    __global float *pixels = image + to.x + (u - slot[SLOT_U]) * to.y + (start - slot[SLOT_V]) * to.z
                             + (size_t)get_global_id(0) * to.w;
    for (int k = 0; k < count; ++k)
        pixels[k * to.z] = total[k];
}
