/* A detector adds photons: -log(sum of w exp(-p)) over times whose weights w sum to 1. It is computed from differences
   between the line integrals p and one of them, so that nearly equal times lose no digits. */
#include "common/lanes.h"

typedef struct {
    vf from;  /* the p from which differences are taken: the least, or at most 80 more */
    vf mean;  /* sum of w (p - from) */
    vf light; /* sum of w (exp(from - p) - 1) */
} intensity_t;

static inline intensity_t intensity_from(const vf p)
{
    intensity_t sum;
    sum.from = p;
    sum.mean = sum.light = (vf)(0.0f);
    return sum;
}

static inline void intensity_add(intensity_t *sum, const vf weight, const vf p)
{
    sum->mean += weight * (p - sum->from);
    sum->light += weight * expm1(min(sum->from - p, 80.0f)); /* exp(80) is finite in float32 */
}

/* How far the average lies below `from`. */
static inline vf intensity_brighter(const intensity_t sum) { return log1p(max(sum.light, -0.9999999f)); }
