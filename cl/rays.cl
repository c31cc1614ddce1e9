/* Ray-driven projector by Joseph's method and its exactly matched adjoint, over all time cells of a frame.
   Everything is in voxel indices (x, y, z); padded layout for image and volume.
   Joseph, IEEE Trans. Med. Imaging 1 (1982) 192: one bilinear sample a plane of the ray's main axis.
   Adjoint without atomics: a voxel gathers from the rays whose samples weigh it. Twin: operators/twins/rays.py. */

#define RAY_CELL 28
#define RAY_SOURCE 0
#define RAY_D00 3      /* from source to pixel (0, 0) */
#define RAY_EU 6
#define RAY_EV 9
#define RAY_WEIGHT 12
#define RAY_MATRIX 13  /* 12: rows give u z, v z, z of a voxel index */

typedef struct { float s[3], d[3]; int axis; float step_mm; } ray_t;

inline ray_t ray_through(__global const float *cell, const float4 pitch_mm, const int u, const int v)
{
    ray_t r;
    const float pitch[3] = {pitch_mm.x, pitch_mm.y, pitch_mm.z};
    float length2 = 0.0f;
    for (int k = 0; k < 3; ++k) {
        r.s[k] = cell[RAY_SOURCE + k];
        r.d[k] = cell[RAY_D00 + k] + (float)u * cell[RAY_EU + k] + (float)v * cell[RAY_EV + k];
        length2 += (r.d[k] * pitch[k]) * (r.d[k] * pitch[k]);
    }
    const float ax = fabs(r.d[0]), ay = fabs(r.d[1]), az = fabs(r.d[2]);
    r.axis = ax >= ay && ax >= az ? 0 : (ay >= az ? 1 : 2);
    r.step_mm = sqrt(length2) / fmax(fmax(ax, ay), az);
    return r;
}

/* one ray; a is the main axis, b and c the others, with strides in the padded volume */
inline float ray_sum(const ray_t r, __global const float *volume, const int na, const int nb, const int nc,
                     const int a, const int b, const int c, const size_t sa, const size_t sb, const size_t sc)
{
    const float inv = 1.0f / r.d[a];
    /* planes between source and detector, then those where both other coordinates touch the volume */
    float lo = fmax(0.0f, fmin(r.s[a], r.s[a] + r.d[a])), hi = fmin((float)(na - 1), fmax(r.s[a], r.s[a] + r.d[a]));
    const float gb = r.d[b] * inv, gc = r.d[c] * inv;
    if (fabs(gb) > 1e-9f) {
        const float p = r.s[a] + (-1.0f - r.s[b]) / gb, q = r.s[a] + ((float)nb - r.s[b]) / gb;
        lo = fmax(lo, fmin(p, q) - 0.01f);
        hi = fmin(hi, fmax(p, q) + 0.01f);
    }
    if (fabs(gc) > 1e-9f) {
        const float p = r.s[a] + (-1.0f - r.s[c]) / gc, q = r.s[a] + ((float)nc - r.s[c]) / gc;
        lo = fmax(lo, fmin(p, q) - 0.01f);
        hi = fmin(hi, fmax(p, q) + 0.01f);
    }
    float sum = 0.0f;
    if (!(hi >= lo))
        return sum;
    const int first = (int)ceil(lo), last = (int)floor(hi);
    for (int i = first; i <= last; ++i) {
        const float t = (float)i - r.s[a];
        const float y = r.s[b] + gb * t, z = r.s[c] + gc * t;
        const float yf = floor(y), zf = floor(z);
        const int j = (int)yf, k = (int)zf;
        const float wy = y - yf, wz = z - zf;
        __global const float *plane = volume + (size_t)i * sa;
        const int j0 = j >= 0 && j < nb, j1 = j + 1 >= 0 && j + 1 < nb;
        const int k0 = k >= 0 && k < nc, k1 = k + 1 >= 0 && k + 1 < nc;
        if (j0 && j1 && k0 && k1) {
            __global const float *at = plane + (size_t)j * sb + (size_t)k * sc;
            sum += (1.0f - wz) * ((1.0f - wy) * at[0] + wy * at[sb]) + wz * ((1.0f - wy) * at[sc] + wy * at[sb + sc]);
        } else {
            if (j0 && k0) sum += (1.0f - wy) * (1.0f - wz) * plane[(size_t)j * sb + (size_t)k * sc];
            if (j1 && k0) sum += wy * (1.0f - wz) * plane[(size_t)(j + 1) * sb + (size_t)k * sc];
            if (j0 && k1) sum += (1.0f - wy) * wz * plane[(size_t)j * sb + (size_t)(k + 1) * sc];
            if (j1 && k1) sum += wy * wz * plane[(size_t)(j + 1) * sb + (size_t)(k + 1) * sc];
        }
    }
    return sum * r.step_mm;
}

__kernel void rays_forward(
    __global const float *volume,     /* guard, then (z, y, pitch) */
    __global const float *cells,      /* (C, RAY_CELL) */
    __global const int *cell_lines,   /* (C, 2) */
    __global const int *line_cells,   /* (lines, 2) */
    const int4 shape, const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int intensity,              /* average transmitted intensity instead of line integrals */
    __global float *image)
{
    const int u = (int)get_global_id(0), v = (int)get_global_id(1);
    if (u >= width || v >= lines)
        return;
    const size_t sy = (size_t)volume_pitch, sz = (size_t)volume_pitch * shape.y;
    __global const float *body = volume + IMAGE_GUARD;
    float total = 0.0f;
    for (int c = line_cells[2 * v]; c < line_cells[2 * v + 1]; ++c) {
        if (v < cell_lines[2 * c] || v >= cell_lines[2 * c + 1])
            continue;
        const ray_t r = ray_through(cells + (size_t)c * RAY_CELL, pitch_mm, u, v);
        float p;
        if (r.axis == 0)
            p = ray_sum(r, body, shape.x, shape.y, shape.z, 0, 1, 2, 1, sy, sz);
        else if (r.axis == 1)
            p = ray_sum(r, body, shape.y, shape.x, shape.z, 1, 0, 2, sy, 1, sz);
        else
            p = ray_sum(r, body, shape.z, shape.x, shape.y, 2, 0, 1, sz, 1, sy);
        total += cells[(size_t)c * RAY_CELL + RAY_WEIGHT] * (intensity ? exp(-p) : p);
    }
    image[IMAGE_GUARD + (size_t)v * image_pitch + u] = intensity ? -log(fmax(total, 1e-37f)) : total;
}

/* weight that the ray's sample puts on the voxel, as rays_forward does */
inline float ray_weight(const ray_t r, const int x, const int y, const int z)
{
    const float index[3] = {(float)x, (float)y, (float)z};
    const int a = r.axis, b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
    const float ahead = index[a] - r.s[a];
    if (index[a] < fmin(r.s[a], r.s[a] + r.d[a]) || index[a] > fmax(r.s[a], r.s[a] + r.d[a]))
        return 0.0f;
    const float inv = 1.0f / r.d[a];
    const float wb = 1.0f - fabs(r.s[b] + (r.d[b] * inv) * ahead - index[b]);
    const float wc = 1.0f - fabs(r.s[c] + (r.d[c] * inv) * ahead - index[c]);
    return wb > 0.0f && wc > 0.0f ? wb * wc * r.step_mm : 0.0f;
}

__kernel void rays_adjoint(
    __global const float *image, __global const float *cells, __global const int *cell_lines,
    const int cell_count,
    const int4 shape, const int volume_pitch, const float4 pitch_mm,
    const int lines, const int width, const int image_pitch,
    const int add,
    __global float *volume)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= shape.x || y >= shape.y || z >= shape.z)
        return;
    float sum = 0.0f;
    for (int c = 0; c < cell_count; ++c) {
        __global const float *cell = cells + (size_t)c * RAY_CELL;
        __global const float *m = cell + RAY_MATRIX;
        const float depth = m[8] * x + m[9] * y + m[10] * z + m[11];
        const float reach = fabs(m[8]) + fabs(m[9]) + fabs(m[10]);
        int u_lo = 0, u_hi = width - 1, v_lo = cell_lines[2 * c], v_hi = cell_lines[2 * c + 1] - 1;
        if (depth + reach <= 0.0f)
            continue;
        if (depth > reach * 1.001f) {
            /* any point within one voxel projects within this window, a bound and not an estimate */
            const float inv = 1.0f / depth, widest = 1.0f / (depth - reach);
            const float u = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inv;
            const float v = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inv;
            const float ru = (fabs(m[0] - u * m[8]) + fabs(m[1] - u * m[9]) + fabs(m[2] - u * m[10])) * widest + 0.01f;
            const float rv = (fabs(m[4] - v * m[8]) + fabs(m[5] - v * m[9]) + fabs(m[6] - v * m[10])) * widest + 0.01f;
            v_lo = max(v_lo, (int)ceil(clamp(v - rv, -1e6f, 1e6f)));
            v_hi = min(v_hi, (int)floor(clamp(v + rv, -1e6f, 1e6f)));
            if (v_hi < v_lo)
                continue;
            u_lo = max(u_lo, (int)ceil(clamp(u - ru, -1e6f, 1e6f)));
            u_hi = min(u_hi, (int)floor(clamp(u + ru, -1e6f, 1e6f)));
        }
        float from_cell = 0.0f;
        for (int v = v_lo; v <= v_hi; ++v)
            for (int u = u_lo; u <= u_hi; ++u) {
                const float h = image[IMAGE_GUARD + (size_t)v * image_pitch + u];
                from_cell += h * ray_weight(ray_through(cell, pitch_mm, u, v), x, y, z);
            }
        sum += cell[RAY_WEIGHT] * from_cell;
    }
    const size_t at = IMAGE_GUARD + ((size_t)z * shape.y + y) * volume_pitch + x;
    volume[at] = add ? volume[at] + sum : sum;
}
