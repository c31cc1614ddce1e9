/* Joseph's samples along LANES rays to one detector line: one bilinear sample on each plane of voxels across the main axis.
   All is in voxel indices (x, y, z). The projector and its adjoints, on CPUs and GPUs, take axis, planes and weights from
   here. Explicit fma fixes the rounding, so a ray has the same samples in all of them.
   RAY_PARALLEL: the rays of a cell have the same direction. RAY_SOURCE is the direction divided by its component along the
   main axis. RAY_D00, RAY_EU and RAY_EV tell where rays meet plane 0; along the main axis they are 1, 0, 0. On plane i these
   rays equal the rays of a cone beam with its source one plane before, at i times the direction (START_OF, AHEAD_OF). */
#include "common/lanes.h"

#define RAY_CELL 16    /* floats per time cell */
#define RAY_SOURCE 0
#define RAY_D00 3      /* from source to pixel (0, 0) */
#define RAY_EU 6
#define RAY_EV 9

#ifndef RAY_PARALLEL
#define RAY_PARALLEL 0
#endif
#if RAY_PARALLEL
#define START_OF(start, i) fma((start), (float)(i), 0.0f) /* fma rounds here: no later sum can fuse the product */
#define AHEAD_OF(start, i) 1.0f
#else
#define START_OF(start, i) (start)
#define AHEAD_OF(start, i) ((float)(i) - (start))
#endif

/* ACROSS: a panel with few rows that is read column by column. Here its lines are its rows, because vectors along the short
   columns would be mostly empty. A cell then serves columns, each with its own weight. */
#ifndef ACROSS
#define ACROSS 0
#endif
#if ACROSS
typedef vf own_t;
#else
typedef float own_t;
#endif

/* The weights of pixels u … u + LANES − 1 of line v, from the weights of a cell. */
static inline own_t weight_of(__global const float *weights, const int u, const int v)
{
#if ACROSS
    return V_LOAD(weights + u);
#else
    return weights[v];
#endif
}

#define BORDER 1       /* zero voxels around a volume in y and z; in x the padding of rows is zero */
#define CLIP_MARGIN 0.01f /* planes by which a clipped range is widened, more than its rounding; samples there weigh 0 */

#if RAY_LONG           /* a volume of 2^31 floats or more */
typedef long index_t;
#if LANES == 1
typedef long vindex;
#define VX_STORE(v, p) (*(p) = (v))
#define V_INDEX(v) ((long)(v))
#else
typedef LANE_TYPE(long, LANES) vindex;
#define VX_STORE(v, p) LANE_TYPE(vstore, LANES)((v), 0, (p))
#define V_INDEX(v) LANE_TYPE(convert_long, LANES)(v)
#endif
#else
typedef int index_t;
typedef vi vindex;
#define VX_STORE(v, p) VI_STORE(v, p)
#define V_INDEX(v) V_INT(v)
#endif

#if LANES == 1
#define VI_IOTA (0)
static inline int v_least(vi v) { return v; }
static inline int v_largest(vi v) { return v; }
#elif LANES == 4
#define VI_IOTA ((vi)(0, 1, 2, 3))
static inline int v_least(vi v) { const int2 b = min(v.lo, v.hi); return min(b.x, b.y); }
static inline int v_largest(vi v) { const int2 b = max(v.lo, v.hi); return max(b.x, b.y); }
#elif LANES == 8
#define VI_IOTA ((vi)(0, 1, 2, 3, 4, 5, 6, 7))
static inline int v_least(vi v) { const int4 a = min(v.lo, v.hi); const int2 b = min(a.lo, a.hi); return min(b.x, b.y); }
static inline int v_largest(vi v) { const int4 a = max(v.lo, v.hi); const int2 b = max(a.lo, a.hi); return max(b.x, b.y); }
#else
#define VI_IOTA ((vi)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
static inline int v_least(vi v)
{
    const int8 c = min(v.lo, v.hi);
    const int4 a = min(c.lo, c.hi);
    const int2 b = min(a.lo, a.hi);
    return min(b.x, b.y);
}
static inline int v_largest(vi v)
{
    const int8 c = max(v.lo, v.hi);
    const int4 a = max(c.lo, c.hi);
    const int2 b = max(a.lo, a.hi);
    return max(b.x, b.y);
}
#endif

/* Always inlined: a call would pass structs of vectors through memory, which takes longer than the computation. */
#ifdef __clang__
#define RAY_INLINE static inline __attribute__((always_inline))
#else
#define RAY_INLINE static inline
#endif

#define LANE(type, v, lane) (((type *)&(v))[lane])

typedef struct { vf x, y, z, step_mm; vi axis; } rays_t;

RAY_INLINE rays_t rays_through(__global const float *cell, const float4 pitch_mm, const vf u, const float v)
{
    rays_t r;
    r.x = fma(u, (vf)(cell[RAY_EU]), (vf)(fma(v, cell[RAY_EV], cell[RAY_D00])));
    r.y = fma(u, (vf)(cell[RAY_EU + 1]), (vf)(fma(v, cell[RAY_EV + 1], cell[RAY_D00 + 1])));
    r.z = fma(u, (vf)(cell[RAY_EU + 2]), (vf)(fma(v, cell[RAY_EV + 2], cell[RAY_D00 + 2])));
#if RAY_PARALLEL
    const vf dx = (vf)(cell[RAY_SOURCE]), dy = (vf)(cell[RAY_SOURCE + 1]), dz = (vf)(cell[RAY_SOURCE + 2]);
#else
    const vf dx = r.x, dy = r.y, dz = r.z;
#endif
    const vf ax = fabs(dx), ay = fabs(dy), az = fabs(dz);
    r.axis = VI_PICK(VI_PICK(2, 1, ay >= az), 0, (ax >= ay) & (ax >= az));
    const vf lx = dx * pitch_mm.x, ly = dy * pitch_mm.y, lz = dz * pitch_mm.z;
    r.step_mm = sqrt(lx * lx + ly * ly + lz * lz) / max(max(ax, ay), az);
    return r;
}

/* LANES rays with main axis a through a box of voxels. On plane i they are at b = s_b + g_b (i - s_a), and likewise at c. In
   a parallel beam i s_b replaces s_b, and 1 replaces i - s_a. */
typedef struct {
    float sa, sb, sc;
    vf gb, gc;
    int a_first, b_first, b_last, c_first, c_last; /* first and last voxel of the box on each axis */
    vi first, last;                                /* planes that each ray meets in the box */
    int lo, hi;                                    /* planes that any of the rays meets */
} walk_t;

/* Narrows [lo, hi] to the planes i on which the coordinate sb + g (i - sa) lies in (below, above). */
RAY_INLINE void clip_planes(const vf g, const float sa, const float sb, const float below, const float above,
                        vf *lo, vf *hi)
{
#if RAY_PARALLEL
    const vf slope = (vf)(sb), start = g;
    const float origin = 0.0f;
#else
    const vf slope = g, start = (vf)(sb);
    const float origin = sa;
#endif
    const vi oblique = fabs(slope) > 1e-9f;
    const vf per = 1.0f / V_PICK(1.0f, slope, oblique);
    const vf p = origin + (below - start) * per, q = origin + (above - start) * per;
    *lo = V_PICK(*lo, max(*lo, min(p, q) - CLIP_MARGIN), oblique);
    *hi = V_PICK(*hi, min(*hi, max(p, q) + CLIP_MARGIN), oblique);
}

/* Finds on which planes the rays `which` meet a box of voxels (first voxel `corner`, sides `size`), for rays with this main
   axis. Returns 0 if none does. */
RAY_INLINE int rays_enter(const rays_t r, __global const float *cell, const int axis, const vi which,
                      const int4 corner, const int4 size, walk_t *w)
{
    const vf da = axis == 0 ? r.x : (axis == 1 ? r.y : r.z);
    const vf db = axis == 0 ? r.y : r.x, dc = axis == 2 ? r.y : r.z;
    const int na = axis == 0 ? size.x : (axis == 1 ? size.y : size.z);
    const int a0 = axis == 0 ? corner.x : (axis == 1 ? corner.y : corner.z);
    w->a_first = a0;
    w->b_first = axis == 0 ? corner.y : corner.x;
    w->c_first = axis == 2 ? corner.y : corner.z;
    w->b_last = w->b_first + (axis == 0 ? size.y : size.x) - 1;
    w->c_last = w->c_first + (axis == 2 ? size.y : size.z) - 1;
    w->sa = cell[RAY_SOURCE + axis];
    w->sb = cell[RAY_SOURCE + (axis == 0 ? 1 : 0)];
    w->sc = cell[RAY_SOURCE + (axis == 2 ? 1 : 2)];
    const vi own = which & (r.axis == axis);
    const vf inv = 1.0f / V_PICK(1.0f, da, own);
    w->gb = V_PICK(0.0f, db * inv, own);
    w->gc = V_PICK(0.0f, dc * inv, own);
    /* Planes between source and detector, then planes on which both other coordinates touch the box. */
    vf lo = (vf)(a0), hi = (vf)(a0 + na - 1);
#if !RAY_PARALLEL
    lo = max(lo, min((vf)(w->sa), w->sa + da));
    hi = min(hi, max((vf)(w->sa), w->sa + da));
#endif
    clip_planes(w->gb, w->sa, w->sb, (float)(w->b_first - 1), (float)(w->b_last + 1), &lo, &hi);
    clip_planes(w->gc, w->sa, w->sc, (float)(w->c_first - 1), (float)(w->c_last + 1), &lo, &hi);
    lo = min(lo, (float)(a0 + na));
    hi = max(hi, (float)(a0 - 1));
    const vi first = V_INT(ceil(lo)), last = V_INT(floor(hi));
    const vi some = own & (first <= last);
    w->first = VI_PICK(a0 + na, first, some);
    w->last = VI_PICK(a0 - 1, last, some);
    w->lo = v_least(w->first);
    w->hi = v_largest(w->last);
    return w->lo <= w->hi;
}

/* The voxel at or below a position, and the weight of the next voxel (share). Outside the box it is in the border of zeros.
   PoCL's floor is slow. Positions are at least -1, so converting position + 1 to an integer does the same. */
RAY_INLINE vi sample_at(const vf g, const float s, const float ahead, const int first, const int last, vf *share)
{
    const vf at = min(max(fma(g, (vf)(ahead), (vf)(s)), (float)first - 1.0f), (float)last + 1.0f);
    const vi whole = min(V_INT(at + 1.0f) - 1, last);
    *share = at - V_FLOAT(whole);
    return whole;
}
