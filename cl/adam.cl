/* Activations of the raw (unconstrained) parameters of Gaussians by softplus, bounded sigmoid and normalisation; their chain
   rule; and a step of Adam. Twins: fields/gaussians.py and optim/__init__.py. */
#include "common/gaussian.h"

static inline vf logistic(vf x) { return 1.0f / (1.0f + exp(-x)); }
static inline vf softplus(vf x) { return max(max(x, 0.0f) + log1p(exp(-fabs(x))), 1e-12f); }

__kernel void activate(
    __global const float *raw, const int count, const int stride, const float scale_min, const float scale_max,
    __global float *gaussians)
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    __global const float *r = raw + first;
    __global float *g = gaussians + first;
    for (int k = 0; k < 3; ++k) {
        V_STORE(V_LOAD(r + (size_t)k * stride), g + (size_t)k * stride);
        V_STORE(scale_min + (scale_max - scale_min) * logistic(V_LOAD(r + (size_t)(ROW_SCALE + k) * stride)),
                g + (size_t)(ROW_SCALE + k) * stride);
    }
    const vf w = V_LOAD(r + 6 * (size_t)stride), x = V_LOAD(r + 7 * (size_t)stride);
    const vf y = V_LOAD(r + 8 * (size_t)stride), z = V_LOAD(r + 9 * (size_t)stride);
    const vf inv = rsqrt(w * w + x * x + y * y + z * z);
    V_STORE(w * inv, g + 6 * (size_t)stride);
    V_STORE(x * inv, g + 7 * (size_t)stride);
    V_STORE(y * inv, g + 8 * (size_t)stride);
    V_STORE(z * inv, g + 9 * (size_t)stride);
    V_STORE(softplus(V_LOAD(r + 10 * (size_t)stride)), g + 10 * (size_t)stride);
}

/* Replaces dL/d(parameters) by dL/d(raw parameters). Adds the gradient of the objective's density term. */
__kernel void chain_activations(
    __global const float *raw, __global const float *gaussians, const int count, const int stride,
    const float scale_min, const float scale_max,
    const float density_weight,      /* the term's weight divided by the number of Gaussians */
    __global float *gradients,       /* (13, stride): dL/d(the 11 parameters), dL/d(centre u, v) */
    __global float *statistics)      /* (2, stride): |dL/d(centre u, v)| summed over frames; in how many frames it is > 0 */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    __global const float *r = raw + first;
    __global const float *g = gaussians + first;
    __global float *d = gradients + first;
    for (int k = 0; k < 3; ++k) {
        __global float *at = d + (size_t)(ROW_SCALE + k) * stride;
        const vf sigma = (V_LOAD(g + (size_t)(ROW_SCALE + k) * stride) - scale_min) / (scale_max - scale_min);
        V_STORE(V_LOAD(at) * (scale_max - scale_min) * sigma * (1.0f - sigma), at);
    }
    vf length2 = (vf)(0.0f);
    for (int k = 0; k < 4; ++k) {
        const vf q = V_LOAD(r + (size_t)(ROW_QUATERNION + k) * stride);
        length2 += q * q;
    }
    const vf inv = rsqrt(length2);
    for (int k = 0; k < 4; ++k) {
        __global float *at = d + (size_t)(ROW_QUATERNION + k) * stride;
        V_STORE(V_LOAD(at) * inv, at);
    }
    __global float *at = d + (size_t)ROW_DENSITY * stride;
    V_STORE((V_LOAD(at) + density_weight) * logistic(V_LOAD(r + (size_t)ROW_DENSITY * stride)), at);

    const vf gu = V_LOAD(d + 11 * (size_t)stride), gv = V_LOAD(d + 12 * (size_t)stride);
    const vf norm = sqrt(gu * gu + gv * gv);
    __global float *stat = statistics + first;
    V_STORE(V_LOAD(stat) + norm, stat);
    V_STORE(V_LOAD(stat + stride) + V_PICK(0.0f, 1.0f, norm > 0.0f), stat + stride);
}

__kernel void adam_step(
    __global float *raw, __global const float *gradients, __global float *moments, /* (2, 11, stride): Adam's two moments */
    const int stride, const float16 rates,      /* learning rates of the 11 rows, including Adam's bias correction */
    const float beta1, const float beta2, const float epsilon)
{
    const int first = (int)get_global_id(0) * LANES, row = (int)get_global_id(1);
    if (first >= stride)
        return;
    const float8 eight = row < 8 ? rates.lo : rates.hi;
    const float4 four = row & 4 ? eight.hi : eight.lo;
    const float2 two = row & 2 ? four.hi : four.lo;
    const float rate = row & 1 ? two.y : two.x;
    const size_t at = (size_t)row * stride + first, second = (size_t)11 * stride;
    const vf g = V_LOAD(gradients + at);
    const vf m = beta1 * V_LOAD(moments + at) + (1.0f - beta1) * g;
    const vf v = beta2 * V_LOAD(moments + second + at) + (1.0f - beta2) * g * g;
    V_STORE(m, moments + at);
    V_STORE(v, moments + second + at);
    V_STORE(V_LOAD(raw + at) - rate * m / (sqrt(v) + epsilon), raw + at);
}
