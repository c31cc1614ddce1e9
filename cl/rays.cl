/* Ray-driven projector by Joseph's method: one bilinear sample per plane of voxels across the ray's main axis (Joseph, IEEE
   Trans. Med. Imaging 1 (1982) 192). A launch projects all time cells of many frames. Rows of frames and volumes are padded;
   a volume has a border of zeros in y and z. Adjoints: rays_adjoint_cpu.cl, rays_adjoint_gpu.cl.
   Twin: operators/twins/rays.py. */
#include "common/ray.h"

__kernel void rays_forward(
    __global const float *volume,     /* guard, then (z, y, pitch) with a border of BORDER in y and z */
    __global const float *cells,      /* (C, RAY_CELL), frame after frame */
    __global const int *cell_lines,   /* (C, 2): lines [first, stop) that a cell serves; ACROSS: columns */
    __global const int *line_cells,   /* (F, lines, 2): cells [first, stop) that may serve a line */
    __global const int *frame_list,   /* numbers of the frames to project */
    __global const float *weights, __global const int *weight_at, /* weights of the cells' lines; where a cell's begin */
    const int4 shape, const int4 origin, /* voxels of the volume, and its first voxel in the grid, x y z */
    const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int add,                    /* 1: adds to the image, for a further part of the volume */
    __global float *image)            /* guard, then (listed frames, lines, pitch) */
{
    const int u = (int)get_global_id(0) * LANES, v = (int)get_global_id(1), n = (int)get_global_id(2);
    if (u >= width)
        return;
    const index_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global const float *body = volume + IMAGE_GUARD + (sy + sz) * BORDER;
    const size_t line = (size_t)frame_list[n] * lines + v;
    const vi real = VI_IOTA + u < width;
    vf total = (vf)(0.0f);
    for (int c = line_cells[2 * line]; c < line_cells[2 * line + 1]; ++c) {
        const int place = ACROSS ? u : v;
        if (place + (ACROSS ? LANES : 1) <= cell_lines[2 * c] || place >= cell_lines[2 * c + 1])
            continue;
        const own_t weight = weight_of(weights + weight_at[c] - cell_lines[2 * c], u, v);
        const vi served = ACROSS ? real & (weight != 0.0f) : real;
        __global const float *cell = cells + (size_t)c * RAY_CELL;
        const rays_t r = rays_through(cell, pitch_mm, (float)u + V_IOTA, (float)v);
        vf p = (vf)(0.0f);
        for (int axis = 0; axis < 3; ++axis) {
            walk_t w;
            if (!rays_enter(r, cell, axis, served, origin, shape, &w))
                continue;
            const index_t sa = axis == 0 ? 1 : (axis == 1 ? sy : sz), sb = axis == 0 ? sy : 1, sc = axis == 2 ? sy : sz;
            for (int i = w.lo; i <= w.hi; ++i) {
                vf wb, wc, v00, v10, v01, v11;
                const vi j = sample_at(w.gb, START_OF(w.sb, i), AHEAD_OF(w.sa, i), w.b_first, w.b_last, &wb);
                const vi k = sample_at(w.gc, START_OF(w.sc, i), AHEAD_OF(w.sa, i), w.c_first, w.c_last, &wc);
                vindex at = V_INDEX(j - w.b_first) * sb + V_INDEX(k - w.c_first) * sc;
                __global const float *plane = body + (i - w.a_first) * sa;
                #pragma unroll
                for (int lane = 0; lane < LANES; ++lane) {
                    __global const float *corner = plane + LANE(index_t, at, lane);
                    LANE(float, v00, lane) = corner[0];
                    LANE(float, v10, lane) = corner[sb];
                    LANE(float, v01, lane) = corner[sc];
                    LANE(float, v11, lane) = corner[sb + sc];
                }
                const vf near = fma(wb, v10 - v00, v00), far = fma(wb, v11 - v01, v01);
                p += V_PICK(0.0f, fma(wc, far - near, near), (w.first <= i) & (w.last >= i));
            }
        }
        p *= r.step_mm;
        total += weight * p;
    }
    __global float *pixels = image + IMAGE_GUARD + ((size_t)n * lines + v) * image_pitch + u;
    if (add)
        total += V_LOAD(pixels);
    V_STORE(V_PICK(0.0f, total, real), pixels);
}
