/* Dot products a·x + t whose result is split into an integer and a small rest. Positions on a detector with 1000 pixels need
   more than the 24 bits of float32. They are computed in float64 or, if the device lacks it, in pairs of floats (high, low)
   with error-free sums and products. The host gives coefficients in the same form. */
#include "common/lanes.h"

#if FP64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#if LANES == 1
typedef double vwide;
#define V_WIDE(v) convert_double(v)
#define WIDE_FLOAT(w) convert_float(w)
#else
typedef LANE_TYPE(double, LANES) vwide;
#define V_WIDE(v) LANE_TYPE(convert_double, LANES)(v)
#define WIDE_FLOAT(w) LANE_TYPE(convert_float, LANES)(w)
#endif
typedef double coefficient;

static inline vwide wide_dot(__global const coefficient *row, vf x, vf y, vf z)
{
    return row[0] * V_WIDE(x) + row[1] * V_WIDE(y) + row[2] * V_WIDE(z) + row[3];
}
static inline vf wide_value(vwide a) { return WIDE_FLOAT(a); }

/* Returns the integer nearest to a/b, limited to ±1e6. rest: a/b minus this integer. */
static inline vf wide_ratio(vwide a, vwide b, vf *rest)
{
    vwide ratio = a / b;
    vf whole = clamp(rint(WIDE_FLOAT(ratio)), -1e6f, 1e6f);
    *rest = WIDE_FLOAT(ratio - V_WIDE(whole));
    return whole;
}
#define COEFFICIENT(c) convert_float(c)

/* Returns the integer nearest to a, limited to ±1e6. rest: a minus this integer. */
static inline vf wide_split(vwide a, vf *rest)
{
    vf whole = clamp(rint(WIDE_FLOAT(a)), -1e6f, 1e6f);
    *rest = WIDE_FLOAT(a - V_WIDE(whole));
    return whole;
}
#else
typedef struct { vf high, low; } vwide;
typedef float2 coefficient;

/* Error-free sums and products. They are wrong if the compiler fuses a multiplication and an addition, so the pragma forbids
   it, and the host leaves -cl-mad-enable out. */
static inline vwide wide_sum(vwide a, vf b)
{
#pragma OPENCL FP_CONTRACT OFF
    vf s = a.high + b;
    vf t = s - a.high;
    vwide r;
    vf error = (a.high - (s - t)) + (b - t);
    r.high = s;
    r.low = a.low + error;
    return r;
}
static inline vwide wide_product_sum(vwide acc, coefficient c, vf x)
{
#pragma OPENCL FP_CONTRACT OFF
    vf product = c.x * x;
    vf error = fma((vf)(c.x), x, -product);
    acc = wide_sum(acc, product);
    acc.low += error + c.y * x;
    return acc;
}
static inline vwide wide_dot(__global const coefficient *row, vf x, vf y, vf z)
{
    vwide acc;
    acc.high = (vf)(row[3].x);
    acc.low = (vf)(row[3].y);
    acc = wide_product_sum(acc, row[0], x);
    acc = wide_product_sum(acc, row[1], y);
    return wide_product_sum(acc, row[2], z);
}
static inline vf wide_value(vwide a) { return a.high + a.low; }

static inline vf wide_ratio(vwide a, vwide b, vf *rest)
{
#pragma OPENCL FP_CONTRACT OFF
    vf whole = clamp(rint(wide_value(a) / wide_value(b)), -1e6f, 1e6f);
    vf product = whole * b.high;
    vf error = fma(whole, b.high, -product);
    vwide left = wide_sum(a, -product);
    vf difference = left.high + (left.low - error - whole * b.low);
    *rest = difference / wide_value(b);
    return whole;
}
#define COEFFICIENT(c) ((c).x)

static inline vf wide_split(vwide a, vf *rest)
{
    vf whole = clamp(rint(wide_value(a)), -1e6f, 1e6f);
    vwide left = wide_sum(a, -whole);
    *rest = left.high + left.low;
    return whole;
}
#endif
