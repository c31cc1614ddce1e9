/* A splat (a Gaussian projected from one time cell): its record in memory, and its value at a pixel.

   D = (u - u0, v - v0) is the offset of a pixel from the splat's centre. num = D'SD; the triangular factor L of S is stored.
   B = 1 + b.D, and Q = B^2 + num/kappa. The line integral of the Gaussian along the pixel's ray is
       p = amp * sqrt(|d|^2 / Q) * exp(-num / (2 Q))
   where d goes from the source to the pixel. This is exact, with perspective: see docs/mathematics.md.
   The affine model (R2-Gaussian) takes Q = 1, and |d| of the central ray for all pixels. */
#include "common/falling_exp2.h"

#ifndef PARALLEL
#define PARALLEL 0 /* the rays of a cell are parallel; AFFINE must be 1 then, and is exact */
#endif

#ifndef DEFORMED
#define DEFORMED 0 /* the object moves, and Gaussians with it: common/splat_state.h */
#endif

#ifndef SPLAT_SPACE
#define SPLAT_SPACE __global /* address space of records and cells */
#endif

#if MOVING
#define RECORD 20 /* floats or ints of a record; RECORD_FLOATS in operators/splats/projector.py */
#else
#define RECORD 16
#endif
#define REC_L11 0
#define REC_L12 1
#define REC_L22 2
#define REC_U_REST 3      /* u0 minus its nearest integer, which is at REC_U_WHOLE */
#define REC_V_REST 4
#define REC_B1 5
#define REC_B2 6
#define REC_INV_KAPPA 7
#define REC_AMP 8         /* amp, including the density and the cell's weight */
#define REC_U_WHOLE 9     /* int */
#define REC_V_WHOLE 10    /* int */
#define REC_U_LO 11       /* int: first and last pixel to visit; no pixel if HI < LO */
#define REC_U_HI 12
#define REC_V_LO 13
#define REC_V_HI 14
#if MOVING                /* instead of L another factor V of S, turned to the direction of motion: common/splat_moving.h */
#define REC_ALONG_U 0
#define REC_ALONG_V 1
#define REC_ACROSS_V 2
#define REC_ACROSS_U 15
#define REC_SPEED 16      /* length of the path in the segment, in standard deviations of the splat along it */
#define REC_REACH2 17     /* limit of |(along, across)|^2 within the cutoff, for the largest Q */
#endif

/* Floats from the first image to the image of a cell. All cells of a frame share one image, unless LAYERED. */
#if LAYERED
#define LAYER_AT(cell, lines, pitch) ((size_t)(cell)[CELL_LAYER] * (IMAGE_GUARD + (size_t)(lines) * (pitch)))
#define LAYERS(count) (count)
#else
#define LAYER_AT(cell, lines, pitch) ((size_t)0)
#define LAYERS(count) 1
#endif

/* A time cell has CELL floats. The constants below are the indices at which they begin. */
#define CELL 24
#define CELL_SOURCE 0     /* 3 floats: the source; PARALLEL: minus the rays' direction */
#define CELL_EU 3         /* 3 floats: the step to the next pixel of a line */
#define CELL_EV 6         /* 3 floats: the step to the next line */
#define CELL_VOLUME 9     /* (eu x ev) . (first pixel - source); PARALLEL: (eu x ev) . (the rays' direction) */
#define CELL_WEIGHT 10
#define CELL_D00 11       /* |d|^2 = D00 + u (DU + DUV v + DUU u) + v (DV + DVV v) */
#define CELL_DU 12
#define CELL_DV 13
#define CELL_DUU 14
#define CELL_DUV 15
#define CELL_DVV 16
#define CELL_LAYER 17     /* LAYERED: the image into which the cell is drawn; each line has at most one cell in an image */

/* The terms of a splat that are constant along one line. */
typedef struct {
    float l11, t0, k, b1, b0, inv_kappa, amp, d0, d1, d2;
} splat_line;

static inline splat_line splat_on_line(SPLAT_SPACE const float *splat_record, SPLAT_SPACE const float *cell, float v, float dv)
{
    splat_line s;
    s.l11 = splat_record[REC_L11];
    s.t0 = splat_record[REC_L12] * dv;
    s.k = (splat_record[REC_L22] * dv) * (splat_record[REC_L22] * dv);
    s.b1 = splat_record[REC_B1];
    s.b0 = 1.0f + splat_record[REC_B2] * dv;
    s.inv_kappa = splat_record[REC_INV_KAPPA];
    s.amp = splat_record[REC_AMP];
    s.d0 = cell[CELL_D00] + v * (cell[CELL_DV] + cell[CELL_DVV] * v);
    s.d1 = cell[CELL_DU] + cell[CELL_DUV] * v;
    s.d2 = cell[CELL_DUU];
    return s;
}

/* The value at pixels u, whose offset from the centre is du. Also returns num, B and 1/Q. */
static inline vf splat_value(splat_line s, vf u, vf du, vf *num_out, vf *big_b, vf *inv_q)
{
    vf t = s.l11 * du + s.t0;
    vf num = t * t + s.k;
#if AFFINE
    *big_b = (vf)(1.0f);
    *inv_q = (vf)(1.0f);
    *num_out = num;
    return s.amp * falling_exp2(MINUS_HALF_LOG2E * num);
#else
    vf b = s.b1 * du + s.b0;
    vf rq = 1.0f / (b * b + num * s.inv_kappa);
    vf d2 = (s.d2 * u + s.d1) * u + s.d0;
    *big_b = b;
    *inv_q = rq;
    *num_out = num;
    return s.amp * sqrt(d2 * rq) * falling_exp2(MINUS_HALF_LOG2E * (num * rq));
#endif
}
