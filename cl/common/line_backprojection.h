/* Backprojects a view whose lines have their own poses to a voxel. For backproject.cl and backproject_moving.cl. */

/* Rounding may move a voxel's image beyond the outermost pixels' centres. IS_ON counts it as seen, ONTO takes it back: else
   a panel of one row would not see voxels at its height. */
#define ROUNDING 1e-3f
#define IS_ON(u, count) (((u) >= -ROUNDING) & ((u) <= (float)((count) - 1) + ROUNDING))
#define ONTO(u, count) clamp((u), 0.0f, (float)((count) - 1))

#define LINE_STEPS 6      /* most Newton steps to find the line that sees a voxel */
#define LEAST_SPEED 0.1f  /* least `speed` that counts, since the Newton steps divide by it */

static inline float line_position(__global const float *m, const float x, const float y, const float z, float *depth)
{
    *depth = m[8] * x + m[9] * y + m[10] * z + m[11];
    return (m[4] * x + m[5] * y + m[6] * z + m[7]) / *depth;
}

static inline float line_sample(__global const float *line, const float position, const int width)
{
    if (!IS_ON(position, width))
        return 0.0f;
    const float u = ONTO(position, width);
    const int column = min((int)u, max(width - 2, 0));
    return line[column] + (u - column) * (line[column + (width > 1)] - line[column]);
}

/* Finds the line r onto which its own pose projects the voxel: v(pose of line r) = r. Returns the line below r, by Newton's
   method from `line` on; v is linear from line to line. t: r minus this line. speed: 1 - (shift of the voxel's image from
   this line's pose to the next line's, in lines). depth, next_depth: the voxel's depth in these two poses. */
static inline int line_seeing(
    __global const float *table, /* (lines, 12): a matrix for the pose of each line */
    const int lines, int line, const float x, const float y, const float z,
    float *t, float *speed, float *depth, float *next_depth)
{
    const int last = max(lines - 2, 0), step = lines > 1 ? 12 : 0;
    *t = 0.0f, *speed = *depth = *next_depth = 1.0f;
    for (int k = 0; k < LINE_STEPS; ++k) {
        __global const float *m = table + (size_t)line * 12;
        const float v = line_position(m, x, y, z, depth), next_v = line_position(m + step, x, y, z, next_depth);
        if (!(*depth > 0.0f && *next_depth > 0.0f))
            break;
        *speed = fmax(1.0f - (next_v - v), LEAST_SPEED);
        *t = (v - (float)line) / *speed;
        const int better = (int)clamp(floor((float)line + *t), 0.0f, (float)last);
        if (better == line)
            break;
        line = k + 1 < LINE_STEPS ? better : line;
    }
    return line;
}

/* A sample's weight is divided by depth², as in FDK, or by depth with DISTANCE_POWER 1. inv = 1/depth. Of a pose per line: at
   the depth `middle` between both lines, and divided by `scale`. */
#if DISTANCE_POWER == 1
#define BY_DISTANCE(weight, inv) (weight) * (inv)
#define BY_LINE(weight, middle, scale) ((weight) / ((middle) * (scale)))
#else
#define BY_DISTANCE(weight, inv) (weight) * (inv) * (inv)
#define BY_LINE(weight, middle, scale) ((weight) / ((middle) * (middle) * (scale)))
#endif

static inline float line_added(
    const float sum, /* the voxel's value so far */
    __global const float *table, __global const float *image, const int lines, const int width, const int image_pitch,
    const float x, const float y, const float z,
    const float weight, const int filtered_across)
{
    const int step = lines > 1 ? 12 : 0;
    float t, speed, depth, next_depth;
    const int line = line_seeing(table, lines, max(lines - 2, 0) / 2, x, y, z, &t, &speed, &depth, &next_depth);
    const float position = (float)line + t, on = ONTO(position, lines) - (float)line;
    if (!(depth > 0.0f && next_depth > 0.0f && IS_ON(position, lines)))
        return sum;
    __global const float *m = table + (size_t)line * 12, *n = m + step;
    __global const float *pixels = image + (size_t)line * image_pitch;
    const float u = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth;
    const float next_u = (n[0] * x + n[1] * y + n[2] * z + n[3]) / next_depth;
    const float here = line_sample(pixels, u, width);
    const float there = line_sample(pixels + (step ? image_pitch : 0), next_u, width);
    const float middle = depth + on * (next_depth - depth);
    return sum + BY_LINE(weight, middle, filtered_across ? speed * speed : speed) * (here + on * (there - here));
}
