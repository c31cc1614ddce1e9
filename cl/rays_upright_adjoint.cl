/* The adjoint of rays.cl where detector columns are parallel to the volume's z and a line has one pose. A ray of a column
   weighs a column of voxels by how near it passes, whatever its line, and lines follow each other along the voxels: what a
   vector of voxels gets is gathered from a few neighbouring lines. One writer per voxel in a fixed order.
   Twin: operators/twins/rays.py. */
#include "common/ray.h"

#define LINE_MARGIN 0.01f /* lines: more than the rounding of where they lie; beyond a voxel's neighbours they weigh nothing */
#define LEAST_SLOPE 1e-6f /* voxels per line: less beside the source, where all lines pass at one height */

/* Frames with columns as rows: every pixel times its ray's length per sample and its cell's weight; 0 where no cell is. */
__kernel void weigh_columns(
    __global const float *cells, __global const int *cell_lines,
    __global const int *frame_cells, __global const int *frame_list,
    const float4 pitch_mm, const int lines, const int width, const int line_pitch,
    __global float *turned)           /* guard, then (listed frames, width, line_pitch) */
{
    const int u = (int)get_global_id(0), n = (int)get_global_id(1);
    if (u >= width)
        return;
    __global float *column = turned + IMAGE_GUARD + ((size_t)n * width + u) * line_pitch;
    for (int v = 0; v < lines; v += LANES) {
        const vi line = VI_IOTA + v;
        vf scale = (vf)(0.0f);
        for (int c = frame_cells[frame_list[n]]; c < frame_cells[frame_list[n] + 1]; ++c) {
            __global const float *cell = cells + (size_t)c * RAY_CELL;
            const float dx = fma((float)u, cell[RAY_EU], cell[RAY_D00]), dy = fma((float)u, cell[RAY_EU + 1], cell[RAY_D00 + 1]);
            const vf dz = fma(V_FLOAT(line), (vf)(cell[RAY_EV + 2]), (vf)(cell[RAY_D00 + 2]));
            const float lx = dx * pitch_mm.x, ly = dy * pitch_mm.y;
            const vf lz = dz * pitch_mm.z;
            const vf own = cell[RAY_WEIGHT] * (sqrt(lx * lx + ly * ly + lz * lz) / fmax(fabs(dx), fabs(dy)));
            scale = V_PICK(scale, own, (line >= cell_lines[2 * c]) & (line < cell_lines[2 * c + 1]));
        }
        V_STORE(V_LOAD(column + v) * scale, column + v); /* padding, where no line has a cell, becomes 0 */
    }
}

/* Columns u (first, last) of the rays that cut a line through the volume, from one end to the other. */
static inline int2 columns_between(__global const float *matrix, const int stride, const float2 x, const float2 y, const int width)
{
#define M(k) matrix[(size_t)(k) * stride]
    const float2 depth = M(8) * x + (M(9) * y + M(11)), u = (M(0) * x + (M(1) * y + M(3))) / depth;
#undef M
    if (!(fmin(depth.x, depth.y) > 1e-3f)) /* the plane of the source cuts it: no bound */
        return (int2)(0, width - 1);
    const float from = fmin(u.x, u.y) - LINE_MARGIN, to = fmax(u.x, u.y) + LINE_MARGIN;
    return (int2)((int)ceil(clamp(from, 0.0f, (float)width)), (int)floor(clamp(to, -1.0f, (float)(width - 1))));
}

/* Lines of a detector column onto two columns of voxels, with the weights near and far. Line v passes them at the height
   at_zero + v slope and shares its value between the voxels below and above. */
RAY_INLINE void lines_onto(__global const float *column, const int line_pitch, const int v_first, const int v_stop,
                           const float at_zero, const float slope, const int z_first, const int nz,
                           const float near, float *low, const float far, float *high)
{
    const float per = fabs(slope) > LEAST_SLOPE ? 1.0f / slope : 1.0f / LEAST_SLOPE, reach = fabs(per) + LINE_MARGIN;
    const int most = (int)fmin(2.0f * reach, (float)(v_stop - v_first - 1)) + 1;
    const int is_dense = fabs(per) * (LANES - 1) + most < (float)(2 * LANES - 2); /* two vectors hold the lines */
    for (int z = 0; z < nz; z += LANES) {
        const vf below = at_zero - (V_IOTA + (float)(z_first + z));
        const vi first = V_INT(min(max(-below * per - reach, (float)v_first - 1.0f), (float)v_stop) + 1.0f);
        const int lowest = min(V_FIRST(first), V_LAST(first)), highest = max(V_FIRST(first), V_LAST(first));
        if (lowest >= v_stop)
            continue;
        vf line = V_FLOAT(first), sum = (vf)(0.0f);
#ifdef V_LOOKUP
        if (is_dense && highest + most <= v_stop) {
            const int base = min(lowest, line_pitch - 2 * LANES);
            const vf values = V_LOAD(column + base), more = V_LOAD(column + base + LANES);
            for (int m = 0; m < most; ++m, line += 1.0f) {
                const vf weight = max(1.0f - fabs(fma(line, (vf)(slope), below)), 0.0f);
                sum = fma(V_LOOKUP(values, more, first + (m - base)), weight, sum);
            }
        } else
#endif
        for (int m = 0; m < most; ++m, line += 1.0f) {
            const vf weight = max(1.0f - fabs(fma(line, (vf)(slope), below)), 0.0f);
            const vf value = GATHER(column, min(first + m, v_stop - 1));
            sum = fma(V_PICK(0.0f, value, line < (float)v_stop), weight, sum);
        }
        V_STORE(fma((vf)(near), sum, V_LOAD(low + z)), low + z);
        V_STORE(fma((vf)(far), sum, V_LOAD(high + z)), high + z);
    }
}

/* A work-item owns ADJOINT_X by ADJOINT_Y columns of voxels. */
__kernel void rays_upright_adjoint(
    __global const float *turned,     /* as weigh_columns leaves it */
    __global const float *cells, __global const int *cell_lines,
    __global const float *matrices, const int matrix_stride, /* (12, matrix_stride): rows give u z, v z, z of a voxel index */
    __global const int *frame_cells, __global const int *frame_list, const int frames,
    const int4 shape, const int4 origin, const int volume_pitch,
    const int width, const int line_pitch,
    const int add,
    __global float *volume)
{
    const int x_first = (int)get_global_id(0) * ADJOINT_X, y_first = (int)get_global_id(1) * ADJOINT_Y;
    const int z_first = (int)get_global_id(2) * ADJOINT_Z;
    if (x_first >= shape.x || y_first >= shape.y || z_first >= shape.z)
        return;
    const int nx = min(ADJOINT_X, shape.x - x_first), ny = min(ADJOINT_Y, shape.y - y_first);
    const int nz = min(ADJOINT_Z, shape.z - z_first);
    const size_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global float *voxels = volume + IMAGE_GUARD + (z_first + BORDER) * sz + (y_first + BORDER) * sy + x_first;
    float sums[ADJOINT_Y][ADJOINT_X][ADJOINT_Z], beyond[ADJOINT_Z];
    for (int z = 0; z < ADJOINT_Z; ++z) {
        beyond[z] = 0.0f;
        for (int y = 0; y < ADJOINT_Y; ++y)
            for (int x = 0; x < ADJOINT_X; ++x)
                sums[y][x][z] = add && z < nz && y < ny && x < nx ? voxels[z * sz + y * sy + x] : 0.0f;
    }
    for (int n = 0; n < frames; ++n) {
        for (int c = frame_cells[frame_list[n]]; c < frame_cells[frame_list[n] + 1]; ++c) {
            __global const float *cell = cells + (size_t)c * RAY_CELL;
            const int v_first = cell_lines[2 * c], v_stop = cell_lines[2 * c + 1];
            const float ez = cell[RAY_EV + 2], dz = cell[RAY_D00 + 2], sc = cell[RAY_SOURCE + 2];
            for (int k = 0; k < nx + ny; ++k) { /* planes x = i, then planes y = i */
                const int along_x = k < nx, own = along_x ? k : k - nx, nb = along_x ? ny : nx;
                const float i = (float)(along_x ? origin.x + x_first + own : origin.y + y_first + own);
                const float b_first = (float)(along_x ? origin.y + y_first : origin.x + x_first);
                const float sa = cell[RAY_SOURCE + !along_x], sb = cell[RAY_SOURCE + along_x], ahead = i - sa;
                const float2 ends = b_first + (float2)(-1.0f, (float)nb);
                const int2 seen = columns_between(matrices + c, matrix_stride, along_x ? (float2)(i) : ends,
                                                  along_x ? ends : (float2)(i), width);
                for (int u = seen.x; u <= seen.y; ++u) {
                    const float dx = fma((float)u, cell[RAY_EU], cell[RAY_D00]);
                    const float dy = fma((float)u, cell[RAY_EU + 1], cell[RAY_D00 + 1]);
                    const float da = along_x ? dx : dy, inv = 1.0f / da;
                    const float at = fma((along_x ? dy : dx) * inv, ahead, sb) - b_first;
                    if ((fabs(dx) >= fabs(dy)) != along_x || !(at > -1.0f && at < (float)nb) || i < fmin(sa, sa + da)
                        || i > fmax(sa, sa + da))
                        continue;
                    const int j = (int)(at + 1.0f) - 1;
                    const float far = at - (float)j, near = 1.0f - far;
                    float *low = j < 0 ? beyond : (along_x ? sums[j][own] : sums[own][j]);
                    float *high = j + 1 >= nb ? beyond : (along_x ? sums[j + 1][own] : sums[own][j + 1]);
                    __global const float *column = turned + IMAGE_GUARD + ((size_t)n * width + u) * line_pitch;
                    lines_onto(column, line_pitch, v_first, v_stop, fma(dz * inv, ahead, sc), ez * inv * ahead,
                               origin.z + z_first, nz, near, low, far, high);
                }
            }
        }
    }
    for (int z = 0; z < nz; ++z)
        for (int y = 0; y < ny; ++y)
            for (int x = 0; x < nx; ++x)
                voxels[z * sz + y * sy + x] = sums[y][x][z];
}
