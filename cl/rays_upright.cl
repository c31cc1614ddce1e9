/* The projector of rays.cl where detector columns are parallel to the volume's z and a pose serves many lines: all rays of
   a detector column then lie in one upright plane. They cut a slice x = const (or y) at one y (or x), so that two columns
   of voxels are blended once for all of them, and a sample reads two numbers instead of four. Volumes are turned, with z
   along a row. Samples and weights are those of rays.cl. Twin: operators/twins/rays.py. */
#include "common/ray.h"

#define TURN 16 /* voxels along x and z that are turned at a time */

/* (z, y, x) as rays.cl has it to guard, then (y, x, pitch) with a border of BORDER in y and x; zeros must be there */
__kernel void turn_upright(
    __global const float *volume, const int4 shape, const int volume_pitch,
    const int column_pitch,
    __global float *columns)
{
    const int x0 = (int)get_global_id(0) * TURN, y = (int)get_global_id(1), z0 = (int)get_global_id(2) * TURN;
    if (x0 >= shape.x || z0 >= shape.z)
        return;
    const size_t sy = volume_pitch, sz = sy * (shape.y + 2 * BORDER);
    __global const float *from = volume + IMAGE_GUARD + (z0 + BORDER) * sz + (y + BORDER) * sy + x0;
    __global float *to = columns + IMAGE_GUARD
                         + ((y + BORDER) * (size_t)(shape.x + 2 * BORDER) + x0 + BORDER) * column_pitch + z0;
    const int wide = min(TURN, shape.x - x0), high = min(TURN, shape.z - z0);
    float tile[TURN][TURN];
    for (int z = 0; z < high; ++z)
        vstore16(vload16(0, from + z * sz), 0, tile[z]);
    for (int x = 0; x < wide; ++x)
        for (int z = 0; z < high; ++z)
            to[(size_t)x * column_pitch + z] = tile[z][x];
}

/* The planes of a detector column's rays along their main axis a, and where they cut them: b = s_b + g_b (i - s_a). */
typedef struct {
    float da, inv, sa, sb, gb;
    int na, nb, a_first, b_first, first, last;
    size_t stride_a, stride_b; /* of a step along a and b among the turned columns */
} upright_t;

RAY_INLINE upright_t upright_planes(__global const float *cell, const float dx, const float dy,
                                    const int4 shape, const int4 origin, const int column_pitch)
{
    upright_t r;
    const int along_x = fabs(dx) >= fabs(dy);
    const size_t row = (size_t)column_pitch * (shape.x + 2 * BORDER);
    r.da = along_x ? dx : dy;
    r.sa = cell[RAY_SOURCE + !along_x];
    r.sb = cell[RAY_SOURCE + along_x];
    r.inv = 1.0f / r.da;
    r.gb = (along_x ? dy : dx) * r.inv;
    r.na = along_x ? shape.x : shape.y;
    r.nb = along_x ? shape.y : shape.x;
    r.a_first = along_x ? origin.x : origin.y;
    r.b_first = along_x ? origin.y : origin.x;
    r.stride_a = along_x ? (size_t)column_pitch : row;
    r.stride_b = along_x ? row : (size_t)column_pitch;
    /* between source and detector, then where b touches the box */
    float lo = fmax((float)r.a_first, fmin(r.sa, r.sa + r.da));
    float hi = fmin((float)(r.a_first + r.na - 1), fmax(r.sa, r.sa + r.da));
    if (fabs(r.gb) > 1e-9f) {
        const float per = 1.0f / r.gb;
        const float p = r.sa + ((float)(r.b_first - 1) - r.sb) * per;
        const float q = r.sa + ((float)(r.b_first + r.nb) - r.sb) * per;
        lo = fmax(lo, fmin(p, q) - CLIP_MARGIN);
        hi = fmin(hi, fmax(p, q) + CLIP_MARGIN);
    }
    r.first = (int)ceil(fmin(lo, (float)(r.a_first + r.na)));
    r.last = (int)floor(fmax(hi, (float)(r.a_first - 1)));
    return r;
}

/* Log average. A work-item takes UPRIGHT_LINES lines of one detector column; the host sees to it that they meet at most
   UPRIGHT_VOXELS voxels of a column. The whole volume at once. */
__kernel void rays_upright(
    __global const float *columns,
    __global const float *cells,      /* (C, RAY_CELL), frame after frame */
    __global const int *cell_lines,   /* (C, 2): first line of a cell and the one after its last */
    __global const int *line_cells,   /* (F, lines, 2): first cell and cell after the last that may serve a line */
    __global const int *frame_list,
    const int4 shape, const int4 origin, const int column_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int block,                  /* lines per work-item, <= UPRIGHT_LINES */
    __global float *image)            /* guard, then (listed frames, lines, pitch) */
{
    const int u = (int)get_global_id(0), n = (int)get_global_id(2);
    const int v_first = (int)get_global_id(1) * block, v_stop = min(v_first + block, lines);
    if (u >= width || v_first >= lines)
        return;
    /* of lines, with room for a vector that begins at any; of voxels, with room for a vector and the next voxel */
    float total[UPRIGHT_LINES + LANES], p[UPRIGHT_LINES + LANES], g[UPRIGHT_LINES + LANES];
    float blended[UPRIGHT_VOXELS + 2 * LANES];
    for (int k = 0; k < UPRIGHT_LINES + LANES; ++k)
        total[k] = 0.0f;
    __global const int *served = line_cells + 2 * ((size_t)frame_list[n] * lines);
    for (int c = served[2 * v_first]; c < served[2 * v_stop - 1]; ++c) {
        const int start = max(v_first, cell_lines[2 * c]), count = min(v_stop, cell_lines[2 * c + 1]) - start;
        if (count <= 0)
            continue;
        __global const float *cell = cells + (size_t)c * RAY_CELL;
        const float dx = fma((float)u, cell[RAY_EU], cell[RAY_D00]), dy = fma((float)u, cell[RAY_EU + 1], cell[RAY_D00 + 1]);
        const upright_t r = upright_planes(cell, dx, dy, shape, origin, column_pitch);
        const float sc = cell[RAY_SOURCE + 2];
        for (int k = 0; k < count; k += LANES) {
            const vf v = (float)(start + k) + V_IOTA;
            V_STORE(fma(v, (vf)(cell[RAY_EV + 2]), (vf)(cell[RAY_D00 + 2])) * r.inv, g + k);
            V_STORE((vf)(0.0f), p + k);
        }
        const int c_first = origin.z, c_last = origin.z + shape.z - 1;
        for (int i = r.first; i <= r.last; ++i) {
            const float ahead = (float)i - r.sa;
            const float at = clamp(fma(r.gb, ahead, r.sb), (float)(r.b_first - 1), (float)(r.b_first + r.nb));
            const int j = min((int)(at + 1.0f) - 1, r.b_first + r.nb - 1);
            const float wb = at - (float)j;
            const size_t column = IMAGE_GUARD + (j - r.b_first + BORDER) * r.stride_b + (i - r.a_first + BORDER) * r.stride_a;
#ifdef V_LOOKUP
            if (fabs(cell[RAY_EV + 2] * r.inv * ahead) * (LANES - 1) < (float)(2 * LANES - 3)) {
                /* LANES lines meet voxels that two vectors hold */
                for (int k = 0; k < count; k += LANES) {
                    vf wc;
                    const vi z = sample_at(V_LOAD(g + k), sc, ahead, c_first, c_last, &wc) - c_first;
                    const int base = min(min(V_FIRST(z), V_LAST(z)), max(shape.z + 1 - 2 * LANES, -1));
                    __global const float *near = columns + column + base, *far = near + r.stride_b;
                    const vf low = V_LOAD(near), high = V_LOAD(near + LANES);
                    const vf lower = fma((vf)(wb), V_LOAD(far) - low, low);
                    const vf upper = fma((vf)(wb), V_LOAD(far + LANES) - high, high);
                    const vf a = V_LOOKUP(lower, upper, z - base), b = V_LOOKUP(lower, upper, z - base + 1);
                    V_STORE(V_LOAD(p + k) + fma(wc, b - a, a), p + k);
                }
                continue;
            }
#endif
            /* voxels that the lines' samples need: from the one below the lowest to the one above the highest */
            const float z0 = fma(g[0], ahead, sc), z1 = fma(g[count - 1], ahead, sc);
            const float lowest = clamp(fmin(z0, z1), (float)(c_first - 1), (float)(c_last + 1));
            const float highest = clamp(fmax(z0, z1), (float)(c_first - 1), (float)(c_last + 1));
            const int base = min((int)(lowest + 1.0f) - 1, c_last), stop = min((int)(highest + 1.0f) - 1, c_last) + 2;
            __global const float *near = columns + column + (base - c_first), *far = near + r.stride_b;
            for (int k = 0; k < stop - base; k += LANES) {
                const vf a = V_LOAD(near + k);
                V_STORE(fma((vf)(wb), V_LOAD(far + k) - a, a), blended + k);
            }
            for (int k = 0; k < count; k += LANES) {
                vf wc;
                /* the last vector's lanes beyond the last line may point outside of what was blended */
                const vi z = sample_at(V_LOAD(g + k), sc, ahead, c_first, c_last, &wc) - base;
                const vi own = min(max(z, 0), stop - base - 2);
                const vf a = GATHER(blended, own), b = GATHER(blended + 1, own);
                V_STORE(V_LOAD(p + k) + fma(wc, b - a, a), p + k);
            }
        }
        for (int k = 0; k < count; ++k) {
            const float dz = fma((float)(start + k), cell[RAY_EV + 2], cell[RAY_D00 + 2]);
            const float lx = dx * pitch_mm.x, ly = dy * pitch_mm.y, lz = dz * pitch_mm.z;
            const float step_mm = sqrt(lx * lx + ly * ly + lz * lz) / fabs(r.da);
            total[start - v_first + k] += cell[RAY_WEIGHT] * (p[k] * step_mm);
        }
    }
    __global float *pixels = image + IMAGE_GUARD + ((size_t)n * lines + v_first) * image_pitch + u;
    for (int k = 0; k < v_stop - v_first; ++k)
        pixels[(size_t)k * image_pitch] = total[k];
}
