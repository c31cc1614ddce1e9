/* The adjoint of rays_upright.cl. A ray of a detector column weighs the voxels of a column by its distance, and lines follow
   each other along the voxels: a vector of voxels gathers from a few neighbouring lines. One writer per voxel, in a fixed
   order. LEAN as in ray_column.h. Twin: operators/twins/rays.py. */
#include "common/ray_column.h"

#define LINE_MARGIN 0.01f /* lines: more than the rounding of where they lie; beyond a voxel's neighbours they weigh nothing */
#define LEAST_SLOPE 1e-6f /* voxels per line: smaller near the source, where all lines have one height */

/* Detector columns (first, last) whose rays may touch a box of voxels. */
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
        if (!(depth > 1e-3f)) /* the plane of the source cuts the box: no bound */
            return (int2)(u_first, u_stop - 1);
        least = fmin(least, u);
        most = fmax(most, u);
    }
    return (int2)(max(u_first, (int)ceil(clamp(least - LINE_MARGIN, -1.0f, (float)u_stop))),
                  min(u_stop - 1, (int)floor(clamp(most + LINE_MARGIN, -1.0f, (float)u_stop))));
}

/* Lines [first, stop) of a slot's column whose main axis is x, or y: all, none, or those on one side of a border. */
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

/* A detector column and where its rays pass: at plane i, ahead of the source, line v at the height
   c = sc + ahead (dz + v ez) / (da + v ea) and at b = sb + across ahead + along (c - sc). The rays lie in a plane. */
typedef struct {
    __global const float *values, *slopes; /* of line v; slopes where columns lean: (dz + v ez) / (da + v ea) */
    int is_cut;                     /* whether lines of the slot beyond the last have the other main axis */
    int v_first, v_stop, last_start; /* last_start: where two vectors may begin at most */
    float sb, sc, da, ea, dz, ez;
    float inv;                      /* 1 / da; of a column that leans one over its turn in the rays' plane */
    float across, along;
    float first, last;              /* slope (dz + v ez) / (da + v ea) of the first and the last line */
    float dense;                    /* largest number of lines to a voxel, times ahead */
} column_t;

RAY_INLINE column_t column_of(__global const float *cell, const int u, const int along_x, const int2 lines)
{
    column_t r;
    r.v_first = lines.x;
    r.v_stop = lines.y;
    r.sb = cell[RAY_SOURCE + along_x];
    r.sc = cell[RAY_SOURCE + 2];
    r.da = ray_component(cell, !along_x, u, 0);
    r.dz = ray_component(cell, 2, u, 0);
    r.ea = LEAN ? cell[RAY_EV + !along_x] : 0.0f;
    r.ez = cell[RAY_EV + 2];
    const float db = ray_component(cell, along_x, u, 0), over_first = r.dz + (float)lines.x * r.ez;
    const float over_last = r.dz + (float)(lines.y - 1) * r.ez;
#if LEAN
    const float eb = cell[RAY_EV + along_x];
    const float near = r.da + (float)lines.x * r.ea, far = r.da + (float)(lines.y - 1) * r.ea;
    r.inv = 1.0f / (r.da * r.ez - r.dz * r.ea);
    r.across = (db * r.ez - r.dz * eb) * r.inv;
    r.along = (r.da * eb - db * r.ea) * r.inv;
    r.first = over_first / near;
    r.last = over_last / far;
    r.dense = fmax(near * near, far * far) * fabs(r.inv);
#else
    r.inv = 1.0f / r.da;
    r.across = db * r.inv;
    r.along = 0.0f;
    r.first = over_first * r.inv;
    r.last = over_last * r.inv;
#endif
    return r;
}

/* the line, not whole, that passes at a height */
RAY_INLINE float line_at(const column_t r, const float ahead, const float height)
{
    const float over = height - r.sc;
    return (over * r.da - ahead * r.dz) / (ahead * r.ez - over * r.ea);
}

/* Where LANES voxels of a column find their lines: `most` from `first` on. */
typedef struct {
    vi first;
    int base;  /* where two vectors of lines begin that hold them all, if they do */
    int some;  /* whether there are any */
    int dense; /* whether two vectors hold them */
} near_lines_t;

RAY_INLINE near_lines_t near_lines(const column_t r, const vf line, const float reach, const int most)
{
    near_lines_t found;
    found.first = V_INT(min(max(line - reach, (float)(r.v_first - 1)), (float)r.v_stop) + 1.0f);
    const int begin = V_FIRST(found.first), end = V_LAST(found.first), lowest = min(begin, end);
    found.some = lowest < r.v_stop;
    found.base = min(lowest, r.last_start);
    found.dense = max(begin, end) + most - found.base <= 2 * LANES;
    return found;
}

#ifdef V_LOOKUP
/* Where two vectors of lines begin for the lower and for the upper half of the voxels; negative where they do not hold them. */
RAY_INLINE int2 bases_of_halves(const column_t r, const near_lines_t lines, const int most)
{
    const int begin = V_FIRST(lines.first), before = V_END_OF_HALF(lines.first);
    const int middle = V_HALF(lines.first), end = V_LAST(lines.first);
    const int2 base = (int2)(min(min(begin, before), r.last_start), min(min(middle, end), r.last_start));
    const int fit = max(begin, before) + most - base.x <= 2 * LANES && max(middle, end) + most - base.y <= 2 * LANES;
    return fit ? base : (int2)(-1);
}
#endif

#if LEAN
/* line first + m of each lane; values are 0 beyond the last */
#define GATHER_SLOPE(m) GATHER(r.slopes, min(lines.first + (m), r.v_stop - 1))
#define GATHER_VALUE(m) V_PICK(0.0f, GATHER(r.values, min(lines.first + (m), r.v_stop - 1)), lines.first + (m) < r.v_stop)

/* the vectors of lines that LANES voxels look theirs up in: lines beyond the last have the other main axis, or are 0 */
#define LINE_VECTORS                                                                                       \
    vf v0 = V_LOAD(r.values + lines.base), v1 = V_LOAD(r.values + lines.base + LANES);                     \
    const vf c0 = V_LOAD(r.slopes + lines.base), c1 = V_LOAD(r.slopes + lines.base + LANES);               \
    vi place = lines.first - lines.base;                                                                   \
    if (r.is_cut) {                                                                                        \
        v0 = V_PICK(0.0f, v0, VI_IOTA + lines.base < r.v_stop);                                            \
        v1 = V_PICK(0.0f, v1, VI_IOTA + (lines.base + LANES) < r.v_stop);                                  \
    }

/* LANES voxels of two columns between which all their lines pass. over: heights from the source on; b: where the rays' plane
   passes at these heights, from the first of the columns on. */
RAY_INLINE void add_between(const column_t r, const near_lines_t lines, const int most, const float ahead, const vf over,
                            const vf b, float *low, float *high)
{
    vf sum = (vf)(0.0f), moment = (vf)(0.0f);
#define ADD(value, slope, next)                                                                                 \
    for (int m = 0; m < most; ++m, next) {                                                                 \
        const vf off = fma(slope, (vf)(ahead), -over), part = (value) * max(1.0f - fabs(off), 0.0f);       \
        sum += part;                                                                                       \
        moment = fma(part, off, moment);                                                                   \
    }
#ifdef V_LOOKUP
    if (lines.dense) {
        LINE_VECTORS
        ADD(V_LOOKUP(v0, v1, place), V_LOOKUP(c0, c1, place), place += 1)
    } else
#endif
        ADD(GATHER_VALUE(m), GATHER_SLOPE(m), (void)0)
#undef ADD
    const vf far = fma(b, sum, r.along * moment);
    V_STORE(V_LOAD(low) + (sum - far), low);
    V_STORE(V_LOAD(high) + far, high);
}

/* LANES voxels of one column, where lines pass from one column to the next. b: from this column on. */
RAY_INLINE void add_across(const column_t r, const near_lines_t lines, const int most, const float ahead, const vf over,
                           const vf b, float *own)
{
    vf sum = (vf)(0.0f);
#define ADD(value, slope, next)                                                                                 \
    for (int m = 0; m < most; ++m, next) {                                                                 \
        const vf off = fma(slope, (vf)(ahead), -over), across = fma(off, (vf)(r.along), b);                \
        sum += (value) * max(1.0f - fabs(off), 0.0f) * max(1.0f - fabs(across), 0.0f);                     \
    }
#ifdef V_LOOKUP
    if (lines.dense) {
        LINE_VECTORS
        ADD(V_LOOKUP(v0, v1, place), V_LOOKUP(c0, c1, place), place += 1)
    } else
#endif
        ADD(GATHER_VALUE(m), GATHER_SLOPE(m), (void)0)
#undef ADD
    V_STORE(V_LOAD(own) + sum, own);
}
#endif

/* Adds a detector column at plane i to columns of voxels that begin at voxel z_first and have nz. Column j of them is
   sums + j step for 0 <= j < nb and `beyond` elsewhere; b_zero: where the column's rays pass at the source's height, b0, b1:
   at its first and its last line, all from column 0 on. */
RAY_INLINE void lines_onto(const column_t r, const float ahead, const int z_first, const int nz, const float b_zero,
                           const float b0, const float b1, const int nb, float *sums, const int step, float *beyond)
{
    const float h0 = fma(r.first, ahead, r.sc) - (float)z_first, h1 = fma(r.last, ahead, r.sc) - (float)z_first;
    const int from = (int)clamp(floor(fmin(h0, h1) - LINE_MARGIN), 0.0f, (float)nz);
    const int stop = (int)clamp(ceil(fmax(h0, h1) + LINE_MARGIN) + 1.0f, 0.0f, (float)nz);
#define COLUMN(j) ((j) < 0 || (j) >= nb ? beyond : sums + (j) * step)
    const int j = (int)floor(fmin(b0, b1));
#if LEAN
    /* lines within a voxel of a height; a little more where lines beyond the ends are denser */
    const float per = r.dense / fmax(fabs(ahead), LEAST_SLOPE);
    float reach = per * (1.0f + 4.0f * fabs(r.ea / r.da) * per) + LINE_MARGIN;
    /* lines are spaced nearly evenly */
    const float bottom = (float)(z_first + from), top = (float)(z_first + stop);
    const float line0 = line_at(r, ahead, bottom), line1 = line_at(r, ahead, top);
    reach += 1.2f * fabs(line_at(r, ahead, 0.5f * (bottom + top)) - 0.5f * (line0 + line1));
    const float per_voxel = (line1 - line0) / fmax(top - bottom, 1.0f), line_zero = line0 - bottom * per_voxel;
    const int most = (int)fmin(2.0f * reach, (float)(r.v_stop - r.v_first - 1)) + 1;
    if (j == (int)floor(fmax(b0, b1))) {
        float *low = COLUMN(j), *high = COLUMN(j + 1);
        for (int z = from; z < stop; z += LANES) {
            const vf height = V_IOTA + (float)(z_first + z), over = height - r.sc;
            const near_lines_t lines = near_lines(r, fma(height, (vf)(per_voxel), (vf)(line_zero)), reach, most);
            if (lines.some)
                add_between(r, lines, most, ahead, over, fma(over, (vf)(r.along), (vf)(b_zero - (float)j)), low + z, high + z);
        }
        return;
    }
    for (int z = from; z < stop; z += LANES) {
        const vf height = V_IOTA + (float)(z_first + z), over = height - r.sc;
        const float at0 = fma(r.along, (float)(z_first + z - 1) - r.sc, b_zero);
        const float at1 = fma(r.along, (float)(z_first + z + LANES) - r.sc, b_zero);
        const int j0 = (int)floor(fmin(at0, at1)), j1 = (int)floor(fmax(at0, at1));
        if (j1 < -1 || j0 >= nb)
            continue;
        const near_lines_t lines = near_lines(r, fma(height, (vf)(per_voxel), (vf)(line_zero)), reach, most);
        if (!lines.some)
            continue;
        const vf b = fma(over, (vf)(r.along), (vf)(b_zero));
        if (j0 == j1)
            add_between(r, lines, most, ahead, over, b - (float)j0, COLUMN(j0) + z, COLUMN(j0 + 1) + z);
        else
            for (int k = max(j0, 0); k <= min(j1 + 1, nb - 1); ++k)
                add_across(r, lines, most, ahead, over, b - (float)k, sums + k * step + z);
    }
#else
    const float far_share = b_zero - (float)j, near_share = 1.0f - far_share;
    float *low = COLUMN(j), *high = COLUMN(j + 1);
    const float slope = r.ez * r.inv * ahead, at_zero = fma(r.dz * r.inv, ahead, r.sc);
    const float per_slope = 1.0f / (fabs(slope) > LEAST_SLOPE ? slope : LEAST_SLOPE), reach = fabs(per_slope) + LINE_MARGIN;
    const int most = (int)fmin(2.0f * reach, (float)(r.v_stop - r.v_first - 1)) + 1;
    for (int z = from; z < stop; z += LANES) {
        const vf height = V_IOTA + (float)(z_first + z), below = at_zero - height;
        const near_lines_t lines = near_lines(r, below * -per_slope, reach, most);
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
        if (base.x >= 0) { /* more lines than voxels */
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

/* A work-item owns ADJOINT_X by ADJOINT_Y columns of voxels. */
__kernel void rays_upright_adjoint(
    __global const float *values,     /* as split_slots leaves them */
    const int slot_columns, const int slot_pitch, const long slots_floats,
    __global const float *cells, __global const int *slots, const int slot_count,
    __global const float *matrices, const int matrix_stride, /* (12, matrix_stride): rows give u z, v z, z of a voxel index */
    const int4 shape, const int4 origin,
    const long4 to,                   /* voxel (z, y, x) at to.x + y to.y + z to.z + x */
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
    float sums[ADJOINT_Y][ADJOINT_X][ADJOINT_Z + LANES], beyond[ADJOINT_Z + LANES]; /* a vector may begin at any voxel */
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
                const int nb = along_x ? ny : nx, step = (along_x ? ADJOINT_X : 1) * (ADJOINT_Z + LANES);
                const int a_first = along_x ? origin.x + x_first : origin.y + y_first;
                const float b_first = (float)(along_x ? origin.y + y_first : origin.x + x_first);
                const float sa = cell[RAY_SOURCE + !along_x];
                const int2 planes = planes_between(cell, u, along_x, a_first, along_x ? nx : ny);
                const float sb = r.sb, sc = r.sc;
                for (int i = planes.x; i <= planes.y; ++i) {
                    r.sb = START_OF(sb, i);
                    r.sc = START_OF(sc, i);
                    const float ahead = AHEAD_OF(sa, i), at = fma(r.across, ahead, r.sb) - b_first;
                    const float at0 = fma(r.along * r.first, ahead, at), at1 = fma(r.along * r.last, ahead, at);
                    if (fmax(at0, at1) <= -1.0f || fmin(at0, at1) >= (float)nb)
                        continue;
                    float *own = along_x ? sums[0][i - a_first] : sums[i - a_first][0];
                    lines_onto(r, ahead, origin.z + z_first, nz, at, at0, at1, nb, own, step, beyond);
                }
            }
        }
    }
    for (int z = 0; z < nz; ++z)
        for (int y = 0; y < ny; ++y)
            for (int x = 0; x < nx; ++x)
                voxels[z * to.z + y * to.y + x] = sums[y][x][z];
}
