/* Projects Gaussians from one time cell: centre on the detector, splat, and pixels within the cutoff. docs/mathematics.md
   derives the formulas. */
#include "common/precise.h"
#include "common/gaussian.h"
#include "common/splat.h"

/* Gaussians whose depth is less than this fraction of the detector's depth are not drawn. So near to the source float32
   cannot tell depths apart, and derivatives, which grow with 1/depth, are huge. */
#define NEAREST 1e-6f

/* A position in pixels: u = u_whole + u_rest, and likewise v. Depth 1 is on the detector. */
typedef struct { vf u_whole, u_rest, v_whole, v_rest, depth; } splat_centre;

/* matrix (12,): its rows give u d, v d and the depth d of a world point. */
ALWAYS_INLINE splat_centre project_centre(__global const coefficient *matrix, const v3 mean)
{
    splat_centre centre;
    const vwide depth = wide_dot(matrix + 8, mean.x, mean.y, mean.z);
    centre.u_whole = wide_ratio(wide_dot(matrix, mean.x, mean.y, mean.z), depth, &centre.u_rest);
    centre.v_whole = wide_ratio(wide_dot(matrix + 4, mean.x, mean.y, mean.z), depth, &centre.v_rest);
    centre.depth = wide_value(depth);
    return centre;
}

/* LANES splats, see common/splat.h. is_drawn: the Gaussian is in front of the source. */
typedef struct { vf l11, l12, l22, b1, b2, inv_kappa, amplitude; vi is_drawn; } splat_view;

ALWAYS_INLINE splat_view view_splat(const gaussian g, __global const float *cell, const vf z)
{
    splat_view s;
    const vf inv_det = g.inv_scale.x * g.inv_scale.y * g.inv_scale.z;
    const v3 end = PARALLEL ? v3_make((vf)(0.0f), (vf)(0.0f), (vf)(0.0f)) : g.mean;
    const v3 from_source = v3_make(end.x - cell[CELL_SOURCE], end.y - cell[CELL_SOURCE + 1], end.z - cell[CELL_SOURCE + 2]);
    const v3 ray = to_local(g.axes, from_source);
    const v3 eu = to_local(g.axes, v3_make((vf)(cell[CELL_EU]), (vf)(cell[CELL_EU + 1]), (vf)(cell[CELL_EU + 2])));
    const v3 ev = to_local(g.axes, v3_make((vf)(cell[CELL_EV]), (vf)(cell[CELL_EV + 1]), (vf)(cell[CELL_EV + 2])));
    const v3 white = v3_mul(ray, g.inv_scale);
    const vf kappa = v3_dot(white, white);
    const vf inv_kappa = 1.0f / kappa;
    const vf root = rsqrt(kappa);
    s.is_drawn = (z > NEAREST) & (kappa > 0.0f);

    /* As inner products of gu and gv, S needs no difference of large numbers, so thin Gaussians lose no digits. */
    const v3 gu = v3_scale(v3_mul(g.scale, v3_cross(ray, eu)), inv_det);
    const v3 gv = v3_scale(v3_mul(g.scale, v3_cross(ray, ev)), inv_det);
    const vf gu_length = sqrt(v3_dot(gu, gu));
    const vf factor = z * root;
    s.l11 = gu_length * factor;
    s.l12 = v3_dot(gu, gv) / gu_length * factor;
    s.l22 = z * z * z * fabs((vf)(cell[CELL_VOLUME])) * inv_det * root / s.l11;
#if DEFORMED
    s.l22 *= fabs(v3_dot(g.axes.a, v3_cross(g.axes.b, g.axes.c)));
#endif
#if AFFINE
    s.b1 = s.b2 = s.inv_kappa = (vf)(0.0f);
    const v3 length_of = DEFORMED ? from_source : ray;
    const vf ray_length = sqrt(v3_dot(length_of, length_of)) / z;
#else
    s.b1 = z * inv_kappa * v3_dot(white, v3_mul(eu, g.inv_scale));
    s.b2 = z * inv_kappa * v3_dot(white, v3_mul(ev, g.inv_scale));
    s.inv_kappa = inv_kappa;
    const vf ray_length = (vf)(1.0f);
#endif
    s.amplitude = cell[CELL_WEIGHT] * 2.50662827463f * g.density * factor * ray_length;
    return s;
}

/* The ellipse q <= cutoff2: its middle (u, v), relative to the splat's centre, and half its extent along u and v.
   is_bounded: 0 if the Gaussian reaches the plane through the source, where it is no ellipse. */
typedef struct { vf u, v, half_u, half_v; vi is_bounded; } cutoff_ellipse;

/* q <= cutoff2 is D'TD - 2 c b.D - c <= 0 with T = S (1 - c/kappa) - c b b'. */
ALWAYS_INLINE cutoff_ellipse ellipse_of(const splat_view s, const float cutoff2)
{
    cutoff_ellipse e;
    const vf l11 = s.l11, l12 = s.l12, l22 = s.l22, b1 = s.b1, b2 = s.b2;
    const vf shrink = 1.0f - cutoff2 * s.inv_kappa;
    const vf t11 = l11 * l11 * shrink - cutoff2 * b1 * b1;
    const vf t12 = l11 * l12 * shrink - cutoff2 * b1 * b2;
    const vf t22 = (l12 * l12 + l22 * l22) * shrink - cutoff2 * b2 * b2;
    /* det T = shrink^2 det S - c shrink b' adj(S) b, in this form again without differences of large numbers. */
    const vf s_b1 = l11 * b2 - l12 * b1, s_b2 = l22 * b1;
    const vf det = shrink * (shrink * (l11 * l22) * (l11 * l22) - cutoff2 * (s_b1 * s_b1 + s_b2 * s_b2));
    e.is_bounded = (shrink > 0.0f) & (det > 0.0f) & (t11 > 0.0f);
    const vf inv_t = 1.0f / det;
    e.u = cutoff2 * (t22 * b1 - t12 * b2) * inv_t;
    e.v = cutoff2 * (t11 * b2 - t12 * b1) * inv_t;
    const vf level = cutoff2 * (1.0f + b1 * e.u + b2 * e.v);
    e.half_u = sqrt(level * t22 * inv_t) * 1.0001f + 0.002f;
    e.half_v = sqrt(level * t11 * inv_t) * 1.0001f + 0.002f;
    return e;
}

/* LANES boxes of pixels, with their bounds included. */
typedef struct { vi u_lo, u_hi, v_lo, v_hi; } pixel_box;

/* Narrows [lo, hi] to the pixels between whole + low and whole + high. */
ALWAYS_INLINE void narrow(const vf whole, const vf low, const vf high, vi *lo, vi *hi)
{
    const vf far = (vf)(4e6f);
    *lo = max(*lo, V_INT(ceil(clamp(whole + low, -far, far))));
    *hi = min(*hi, V_INT(floor(clamp(whole + high, -far, far))));
}

/* Empties the boxes of splats that are not drawn or contain no pixel. Returns which splats remain. */
ALWAYS_INLINE vi close_box(pixel_box *box, const vi is_drawn)
{
    const vi is_visible = is_drawn & (box->u_hi >= box->u_lo) & (box->v_hi >= box->v_lo);
    box->u_lo = VI_PICK(1, box->u_lo, is_visible);
    box->u_hi = VI_PICK(0, box->u_hi, is_visible);
    box->v_lo = VI_PICK(1, box->v_lo, is_visible);
    box->v_hi = VI_PICK(0, box->v_hi, is_visible);
    return is_visible;
}

/* The box from which `enclose` starts. */
ALWAYS_INLINE pixel_box empty_box(void)
{
    pixel_box box;
    box.u_lo = box.v_lo = (vi)(0x7fffffff);
    box.u_hi = box.v_hi = (vi)(-1);
    return box;
}

ALWAYS_INLINE void enclose(pixel_box *extent, const pixel_box box, const vi is_visible)
{
    extent->u_lo = VI_PICK(extent->u_lo, min(extent->u_lo, box.u_lo), is_visible);
    extent->u_hi = VI_PICK(extent->u_hi, max(extent->u_hi, box.u_hi), is_visible);
    extent->v_lo = VI_PICK(extent->v_lo, min(extent->v_lo, box.v_lo), is_visible);
    extent->v_hi = VI_PICK(extent->v_hi, max(extent->v_hi, box.v_hi), is_visible);
}
