/* A Gaussian of an object that moves, in one of its states (cl/splat_states.cl). The object has at y what the reference
   has at y + w(y), and G = I + dw/dy. A Gaussian with precision P in the reference has precision G' P G in the state. So a
   vector v has the coordinates R' G v in the Gaussian's own axes: G' R replaces the axes R. */
#include "common/gaussian.h"
#include "common/splat.h"

#define STATE_ROWS 12 /* floats of a Gaussian in a state: its centre x y z, then the rows of G */

#if DEFORMED
/* Where LANES Gaussians of a state begin in the array (S, STATE_ROWS, stride). */
#define STATE_AT(state, first, stride) ((size_t)(state) * STATE_ROWS * (stride) + (first))

ALWAYS_INLINE v3 state_vector(__global const float *rows, const int row, const int stride)
{
    __global const float *at = rows + (size_t)row * stride;
    return v3_make(V_LOAD(at), V_LOAD(at + stride), V_LOAD(at + 2 * (size_t)stride));
}

#define MEAN_IN_STATE(g, rows, stride) state_vector(rows, 0, stride)

ALWAYS_INLINE gaussian gaussian_in_state(gaussian g, __global const float *rows, const int stride)
{
    const frame3 pull = {state_vector(rows, 3, stride), state_vector(rows, 6, stride), state_vector(rows, 9, stride)};
    g.mean = state_vector(rows, 0, stride);
    g.axes.a = to_world(pull, g.axes.a);
    g.axes.b = to_world(pull, g.axes.b);
    g.axes.c = to_world(pull, g.axes.c);
    return g;
}
#else
#define STATE_AT(state, first, stride) 0
#define gaussian_in_state(g, rows, stride) (g)
#define MEAN_IN_STATE(g, rows, stride) ((g).mean)
#endif
