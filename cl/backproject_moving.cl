/* FDK's backprojection of an object that moves. At the time of a view, matter from voxel x of the reference is at x + u(x).
   u is interpolated between the displacements of two states; weights.y is the second state's fraction. Apart from u, the
   kernels do what those of backproject.cl do. Twins: operators/twins/rays.py.
     push_displacement       solves u(x) = -w(x + u(x)) for one state; a work-item takes LANES voxels along x
     backproject_moving      any pose; a work-item takes LANES voxels along x and loops over the views
     backproject_lines_moving  every line of a frame has its own pose; a work-item takes one voxel */
#include "common/lanes.h"
#include "common/line_backprojection.h"

#define PUSH_CLOSE 1e-4f /* the iteration for u ends when a step is shorter than this, in voxels */

static inline vf lerp(const vf low, const vf high, const vf share) { return low + share * (high - low); }

#define V_BETWEEN(v, last) clamp((v), (vf)(0.0f), (vf)((float)(last)))

/* Trilinear interpolation in a field (nz, ny, nx). Outside, the value of the nearest point of its surface is taken. */
static inline vf sample_at(__global const float *field, const int4 shape, const vf x, const vf y, const vf z)
{
    const vf px = V_BETWEEN(x, shape.x - 1), py = V_BETWEEN(y, shape.y - 1), pz = V_BETWEEN(z, shape.z - 1);
    const vi ix = min(V_INT(px), max(shape.x - 2, 0)), iy = min(V_INT(py), max(shape.y - 2, 0));
    const vi iz = min(V_INT(pz), max(shape.z - 2, 0));
    const vf fx = px - V_FLOAT(ix), fy = py - V_FLOAT(iy), fz = pz - V_FLOAT(iz);
    const int along_x = shape.x > 1, along_y = shape.y > 1 ? shape.x : 0;
    __global const float *above = field + (shape.z > 1 ? (size_t)shape.y * shape.x : 0);
    const vi at = (iz * shape.y + iy) * shape.x + ix;
    const vf low = lerp(lerp(GATHER(field, at), GATHER(field + along_x, at), fx),
                        lerp(GATHER(field + along_y, at), GATHER(field + along_y + along_x, at), fx), fy);
    const vf high = lerp(lerp(GATHER(above, at), GATHER(above + along_x, at), fx),
                         lerp(GATHER(above + along_y, at), GATHER(above + along_y + along_x, at), fx), fy);
    return lerp(low, high, fz);
}

__kernel void push_displacement(
    __global const float *pull, /* (3: x y z, wide): w, in voxels, on a wider grid; then zeros that vectors may read */
    const int4 wide, const int4 margin, /* sides x y z of the wider grid; where the grid begins in it */
    const int4 shape, const int most_steps,
    __global float *push)       /* (3: x y z, shape): the displacement in voxels */
{
    const int first = (int)get_global_id(0) * LANES, y = get_global_id(1), z = get_global_id(2);
    if (first >= shape.x)
        return;
    const size_t voxels = (size_t)shape.x * shape.y * shape.z, each = (size_t)wide.x * wide.y * wide.z;
    const size_t voxel = ((size_t)z * shape.y + y) * shape.x + first;
    const vf px = V_IOTA + (float)(first + margin.x), py = (float)(y + margin.y), pz = (float)(z + margin.z);
    vf ux = 0.0f, uy = 0.0f, uz = 0.0f;
    for (int step = 0; step < most_steps; ++step) {
        const vf next_x = -sample_at(pull, wide, px + ux, py + uy, pz + uz);
        const vf next_y = -sample_at(pull + each, wide, px + ux, py + uy, pz + uz);
        const vf next_z = -sample_at(pull + 2 * each, wide, px + ux, py + uy, pz + uz);
        const vf change = fabs(next_x - ux) + fabs(next_y - uy) + fabs(next_z - uz);
        ux = next_x;
        uy = next_y;
        uz = next_z;
        if (!V_ANY(change > PUSH_CLOSE))
            break;
    }
    const int count = min(LANES, shape.x - first);
    float xs[LANES], ys[LANES], zs[LANES];
    V_STORE(ux, xs);
    V_STORE(uy, ys);
    V_STORE(uz, zs);
    for (int l = 0; l < count; ++l) {
        push[voxel + l] = xs[l];
        push[voxels + voxel + l] = ys[l];
        push[2 * voxels + voxel + l] = zs[l];
    }
}

/* Loads the first state's displacement of LANES voxels along an axis, and its difference to the second state's. */
#define TWO_STATES(name, axis)                                                   \
    const vf name##_0 = V_LOAD(first_push + axis * voxels + voxel);              \
    const vf name##_1 = V_LOAD(second_push + axis * voxels + voxel) - name##_0;

__kernel void backproject_moving(
    __global const float *projections, __global const float *matrices,
    __global const float2 *weights, /* (views,): the view's weight, and the fraction of the second state */
    const int views, const int rows, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    __global const float *first_push, __global const float *second_push, /* (3: x y z, grid): u of both states in voxels */
    const int4 grid,
    __global float *volume)
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= shape.x)
        return;
    const int iy = (int)get_global_id(1) + origin.y, iz = (int)get_global_id(2) + origin.z;
    __global float *target = volume + IMAGE_GUARD
                             + (get_global_id(2) * shape.y + get_global_id(1)) * volume_pitch + first;
    const size_t voxels = (size_t)grid.x * grid.y * grid.z;
    const size_t voxel = ((size_t)iz * grid.y + iy) * grid.x + first + origin.x;
    TWO_STATES(push_x, 0)
    TWO_STATES(push_y, 1)
    TWO_STATES(push_z, 2)
    const int next_row = rows > 1 ? image_pitch : 0, next = width > 1 ? 1 : 0;
    vf sum = V_LOAD(target);
    for (int f = 0; f < views; ++f) {
        __global const float *m = matrices + (size_t)f * 12;
        __global const float *image = projections + f * image_step + IMAGE_GUARD;
        const float share = weights[f].y;
        const vf x = V_IOTA + (float)(first + origin.x) + push_x_0 + share * push_x_1;
        const vf y = (float)iy + push_y_0 + share * push_y_1, z = (float)iz + push_z_0 + share * push_z_1;
        const vf depth = m[8] * x + m[9] * y + m[10] * z + m[11];
        const vf inv = 1.0f / depth;
        const vf u = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inv;
        const vf v = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inv;
        const vi inside = IS_ON(u, width) & IS_ON(v, rows) & (depth > 0.0f);
        const vf us = ONTO(V_PICK(0.0f, u, inside), width), vs = ONTO(V_PICK(0.0f, v, inside), rows);
        const vi column = min(V_INT(us), max(width - 2, 0)), row = min(V_INT(vs), max(rows - 2, 0));
        const vf wu = us - V_FLOAT(column), wv = vs - V_FLOAT(row);
        const vi at = row * image_pitch + column;
        const vf lower = lerp(GATHER(image, at), GATHER(image + next, at), wu);
        const vf upper = lerp(GATHER(image + next_row, at), GATHER(image + next_row + next, at), wu);
        sum += V_PICK(0.0f, weights[f].x * inv * inv * lerp(lower, upper, wv), inside);
    }
    V_STORE(V_PICK(0.0f, sum, V_IOTA < (float)(shape.x - first)), target); /* padding stays zero */
}

__kernel void backproject_lines_moving(
    __global const float *projections, __global const float *matrices, __global const float2 *weights,
    const int views, const int lines, const int width, const int image_pitch, const long image_step,
    const int4 shape, const int4 origin, const int volume_pitch,
    const int filtered_across,
    __global const float *first_push, __global const float *second_push, const int4 grid,
    __global float *volume)
{
    if (get_global_id(0) >= shape.x)
        return;
    const int ix = (int)get_global_id(0) + origin.x, iy = (int)get_global_id(1) + origin.y;
    const int iz = (int)get_global_id(2) + origin.z;
    __global float *target = volume + IMAGE_GUARD
                             + (get_global_id(2) * shape.y + get_global_id(1)) * volume_pitch + get_global_id(0);
    const size_t voxels = (size_t)grid.x * grid.y * grid.z, voxel = ((size_t)iz * grid.y + iy) * grid.x + ix;
    float moved[3];
    float sum = *target;
    for (int f = 0; f < views; ++f) {
        for (int axis = 0; axis < 3; ++axis) {
            const float low = first_push[axis * voxels + voxel], high = second_push[axis * voxels + voxel];
            moved[axis] = low + weights[f].y * (high - low);
        }
        sum = line_added(
            sum, matrices + (size_t)f * lines * 12, projections + f * image_step + IMAGE_GUARD, lines, width, image_pitch,
            (float)ix + moved[0], (float)iy + moved[1], (float)iz + moved[2], weights[f].x, filtered_across);
    }
    *target = sum;
}
