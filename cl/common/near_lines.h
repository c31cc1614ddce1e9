/* Which pixels (lines) of a detector column have rays near a column of voxels along z, and what these rays add to it
   (rays_upright_adjoint.cl). LEAN: see ray_column.h. */
#include "common/ray_column.h"

#define LEAST_SLOPE 1e-6f /* least distance between lines that counts, in voxels: at the source it is 0 */

/* A detector column and its rays, which lie in a plane. On the plane of voxels that is `ahead` planes from the source, the
   ray of line v is at the height c = sc + ahead (dz + v ez) / (da + v ea), and at b = sb + across ahead + along (c - sc)
   along the other axis. */
typedef struct {
    __global const float *values, *slopes; /* one per line v; slopes (LEAN only): (dz + v ez) / (da + v ea) */
    int is_cut;                     /* whether further lines have the other main axis */
    int v_first, v_stop, last_start; /* last_start: the last line from which two vectors can be loaded */
    float sb, sc, da, ea, dz, ez;
    float inv;                      /* 1 / da; if LEAN, 1 / (da ez - dz ea) */
    float bend, per_along;          /* 4 |ea / da|: how much denser lines beyond the ends are; 1 / |along| */
    float across, along;
    float first, last;              /* slopes of the first and the last line */
    float dense;                    /* largest number of lines per voxel, multiplied by `ahead` */
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
    r.bend = 4.0f * fabs(r.ea / r.da);
    r.per_along = 1.0f / fmax(fabs(r.along), LEAST_SLOPE);
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

/* The lines whose rays may touch LANES voxels of a column: in each lane, a fixed number of lines from `first` on. */
typedef struct {
    vi first;
    int base;  /* first line of two vectors that contain the lines of all lanes, if `dense` */
    int some;  /* whether any ray may touch */
    int dense; /* whether two vectors contain the lines of all lanes */
} near_lines_t;

RAY_INLINE near_lines_t near_lines(const column_t r, const vi first, const int most)
{
    near_lines_t found;
    found.first = first;
    const int begin = V_FIRST(first), end = V_LAST(first), lowest = min(begin, end);
    found.some = lowest < r.v_stop;
    found.base = min(lowest, r.last_start);
    found.dense = max(begin, end) + most - found.base <= 2 * LANES;
    return found;
}

#ifdef V_LOOKUP
/* The first lines of two vectors for the lower half of the voxels, and of two for the upper half; negative if that is not
   enough. */
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
/* Slope and value of line first + m in each lane. Beyond the last line the value is 0. */
#define GATHER_SLOPE(m) GATHER(r.slopes, min(lines.first + (m), r.v_stop - 1))
#define GATHER_VALUE(m) V_PICK(0.0f, GATHER(r.values, min(lines.first + (m), r.v_stop - 1)), lines.first + (m) < r.v_stop)

/* Loads the vectors in which LANES voxels look up their lines, and sets lines of the other main axis to 0. */
#define LINE_VECTORS                                                                                       \
    vf v0 = V_LOAD(r.values + lines.base), v1 = V_LOAD(r.values + lines.base + LANES);                     \
    const vf c0 = V_LOAD(r.slopes + lines.base), c1 = V_LOAD(r.slopes + lines.base + LANES);               \
    vi place = lines.first - lines.base;                                                                   \
    if (r.is_cut) {                                                                                        \
        v0 = V_PICK(0.0f, v0, VI_IOTA + lines.base < r.v_stop);                                            \
        v1 = V_PICK(0.0f, v1, VI_IOTA + (lines.base + LANES) < r.v_stop);                                  \
    }

/* Runs `body` for all lines that may touch LANES voxels. `value`: of the line. `off`: the ray's height minus the voxel's. */
#define OF_LINES(value_of, slope_of, next, body)                                                           \
    for (int m = 0; m < most; ++m, next) {                                                                 \
        const vf value = value_of, off = fma(slope_of, (vf)(ahead), under);                                \
        body                                                                                               \
    }
#ifdef V_LOOKUP
#define EACH_LINE(body)                                                                                    \
    if (lines.dense) {                                                                                     \
        LINE_VECTORS                                                                                       \
        OF_LINES(V_LOOKUP(v0, v1, place), V_LOOKUP(c0, c1, place), place += 1, body)                       \
    } else                                                                                                 \
        OF_LINES(GATHER_VALUE(m), GATHER_SLOPE(m), (void)0, body)
#else
#define EACH_LINE(body) OF_LINES(GATHER_VALUE(m), GATHER_SLOPE(m), (void)0, body)
#endif

/* Adds to LANES voxels of two columns, if all rays pass between these. under: the source's height minus the voxels'. b: the
   place of the rays at the voxels' heights, counted from the first column. */
RAY_INLINE void add_between(const column_t r, const near_lines_t lines, const int most, const float ahead, const vf under,
                            const vf b, float *low, float *high)
{
    vf sum = (vf)(0.0f), moment = (vf)(0.0f);
    EACH_LINE(const vf part = value * max(1.0f - fabs(off), 0.0f); sum += part; moment = fma(part, off, moment);)
    const vf far = fma(b, sum, r.along * moment);
    V_STORE(V_LOAD(low) + (sum - far), low);
    V_STORE(V_LOAD(high) + far, high);
}

/* Adds to LANES voxels of three columns, if rays pass on both sides of the second. b: counted from the second column. */
RAY_INLINE void add_around(const column_t r, const near_lines_t lines, const int most, const float ahead, const vf under,
                           const vf b, float *low, float *middle, float *high)
{
    vf sum = (vf)(0.0f), before = (vf)(0.0f), after = (vf)(0.0f);
    EACH_LINE(const vf part = value * max(1.0f - fabs(off), 0.0f); const vf across = fma(off, (vf)(r.along), b);
              sum += part; before = fma(part, max(-across, 0.0f), before); after = fma(part, max(across, 0.0f), after);)
    V_STORE(V_LOAD(low) + before, low);
    V_STORE(V_LOAD(middle) + (sum - before - after), middle);
    V_STORE(V_LOAD(high) + after, high);
}

/* Adds to LANES voxels of one column, if rays pass over more than three columns. b: counted from this column. */
RAY_INLINE void add_across(const column_t r, const near_lines_t lines, const int most, const float ahead, const vf under,
                           const vf b, float *own)
{
    vf sum = (vf)(0.0f);
    EACH_LINE(const vf across = fma(off, (vf)(r.along), b);
              sum += value * max(1.0f - fabs(off), 0.0f) * max(1.0f - fabs(across), 0.0f);)
    V_STORE(V_LOAD(own) + sum, own);
}
#endif
