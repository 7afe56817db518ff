/* Large motion: every displacement within reach is tried on a coarse level (after Steinbrücker, Pock, Cremers
   2009: costs and smoothness are coupled by a quadratic term and minimised in turns); there and on finer levels
   each pixel takes over a flow from beside it where that fits better (after Barnes et al. 2009).

   A descriptor is (h, dh/dx, dh/dy, valid), divided by how strongly its neighbourhood varies: the same in bright
   and dark, sharp and dull places. Flow is in pixels of the level's grid; grid = (width, height, wraps, 0).
   A displacement has the index (d.y + reach.y) * (2 reach.x + 1) + d.x + reach.x. */

#define SEARCH_SLOPE 1.5f /* weight of the derivatives beside h */
#define SEARCH_WINDOW 81  /* pixels of the largest window in which flows are compared: its radius is 4 */

/* Features over the root of their mean square in 7 x 7 pixels. */
__kernel void search_descriptor(__global const float4 *feature, /* (grid.y, grid.x) kernels/flow.cl */
                                int4 grid,                      /* run size */
                                float noise,                    /* amplitude of h that is no texture */
                                __global float4 *descriptor)    /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float energy = 0.0f, weight = 0.0f;
    for (int j = -3; j <= 3; ++j)
        for (int i = -3; i <= 3; ++i) {
            int2 p = (int2)(x + i, y + j);
            if (!grid_border(&p, grid))
                continue;
            const float4 f = feature[p.y * grid.x + p.x];
            energy += f.w * (f.x * f.x + SEARCH_SLOPE * SEARCH_SLOPE * (f.y * f.y + f.z * f.z));
            weight += f.w;
        }
    const float4 f = feature[y * grid.x + x];
    const float scale = 1.0f / (sqrt(energy / fmax(weight, 1.0f)) + noise);
    descriptor[y * grid.x + x] = (float4)(f.x * scale, SEARCH_SLOPE * scale * f.yz, f.w);
}

/* How badly two descriptors fit, 0..1; `outside` where one is not known. */
static inline float search_misfit(float4 a, float4 b, float outside) {
    const float3 d = a.xyz - b.xyz;
    const float e = dot(d, d);
    return a.w * b.w > 0.0f ? e / (e + 0.5f) : outside;
}

/* Misfit of each pixel under each displacement; -1 where the first image is not known. */
__kernel void search_pixel_cost(__global const float4 *a, /* (grid.y, grid.x) descriptors */
                                __global const float4 *b, /* (grid.y, grid.x) of the other image */
                                int4 grid,                /* run size: (grid.x, grid.y x displacements) */
                                int2 reach,               /* largest displacement, px */
                                float outside,            /* misfit where one of both is not known */
                                __global float *cost)     /* (displacements, grid.y, grid.x) */
{
    const int x = get_global_id(0), row = get_global_id(1);
    const int index = row / grid.y, y = row - index * grid.y, span = 2 * reach.x + 1;
    if (x >= grid.x || index >= span * (2 * reach.y + 1))
        return;
    const float4 own = a[y * grid.x + x];
    int2 q = (int2)(x, y) + (int2)(index % span, index / span) - reach;
    const float misfit = grid_border(&q, grid) ? search_misfit(own, b[q.y * grid.x + q.x], outside) : outside;
    cost[row * grid.x + x] = own.w > 0.0f ? misfit : -1.0f;
}

/* Costs at columns x to x + 7 of a row; `outside` beyond the grid. */
static inline float8 search_row(__global const float *row, int x, int4 grid, float outside) {
    if (x >= 0 && x + 8 <= grid.x)
        return vload8(0, row + x);
    float lanes[8];
    for (int i = 0; i < 8; ++i) {
        int2 p = (int2)(x + i, 0);
        lanes[i] = grid_border(&p, grid) ? row[p.x] : outside;
    }
    return vload8(0, lanes);
}

/* Mean over what is known of 3 x 3 pixels, under each displacement; eight pixels at a time. */
__kernel void search_cost(__global const float *pixel_cost, /* (displacements, grid.y, grid.x), -1: not known */
                          int4 grid,                        /* run size: (ceil(grid.x / 8), grid.y x displacements) */
                          int displacements,
                          float outside,                    /* cost where none is known */
                          __global float *cost)             /* (displacements, grid.y, grid.x) */
{
    const int x = 8 * get_global_id(0), row = get_global_id(1);
    const int index = row / grid.y, y = row - index * grid.y, count = LEAST(8, grid.x - x);
    if (count <= 0 || index >= displacements)
        return;
    float8 sum = (float8)(0.0f), weight = (float8)(0.0f);
    for (int j = y > 0 ? -1 : 0; j <= (y + 1 < grid.y ? 1 : 0); ++j)
        for (int i = -1; i <= 1; ++i) {
            const float8 c = search_row(pixel_cost + (row + j) * grid.x, x + i, grid, -1.0f);
            sum += c >= 0.0f ? c : (float8)(0.0f);
            weight += c >= 0.0f ? (float8)(1.0f) : (float8)(0.0f);
        }
    float mean[8];
    vstore8(weight > 0.0f ? sum / weight : (float8)(outside), 0, mean);
    for (int i = 0; i < count; ++i)
        cost[row * grid.x + x + i] = mean[i];
}

/* The displacement that costs least, with what it is away from `flow`; eight pixels at a time. */
__kernel void search_best(__global const float *cost,  /* (displacements, grid.y, grid.x) from a to b */
                          __global const float2 *flow, /* (grid.y, grid.x) px */
                          int4 grid,                   /* run size: (ceil(grid.x / 8), grid.y) */
                          int2 reach,                  /* px */
                          float outside,               /* cost of what lies beyond the grid */
                          float coupling,              /* cost of a squared pixel away from flow */
                          int backward,                /* 1: flow from b to a */
                          __global float2 *best)       /* (grid.y, grid.x) px */
{
    const int x = 8 * get_global_id(0), y = get_global_id(1), count = min(8, grid.x - x);
    if (count <= 0 || y >= grid.y)
        return;
    float near_x[8], near_y[8];
    for (int i = 0; i < 8; ++i) {
        const float2 near = flow[y * grid.x + x + min(i, count - 1)];
        near_x[i] = near.x;
        near_y[i] = near.y;
    }
    const float8 from_x = vload8(0, near_x), from_y = vload8(0, near_y);
    float8 least = (float8)(INFINITY), found_x = from_x, found_y = from_y;
    for (int v = -reach.y; v <= reach.y; ++v) {
        const float8 away_y = (float)v - from_y, down = away_y * away_y;
        const int row = backward ? y + v : y; /* what b shows at q, a shows at q + d: the cost of -d there */
        const bool inside = row >= 0 && row < grid.y;
        for (int u = -reach.x; u <= reach.x; ++u) {
            const int2 d = backward ? (int2)(-u, -v) : (int2)(u, v);
            const int index = (d.y + reach.y) * (2 * reach.x + 1) + d.x + reach.x;
            const float8 own =
                inside ? search_row(cost + (index * grid.y + row) * grid.x, backward ? x + u : x, grid, outside)
                       : (float8)(outside);
            const float8 away_x = (float)u - from_x, total = own + coupling * (away_x * away_x + down);
            const int8 less = total < least;
            least = select(least, total, less);
            found_x = select(found_x, (float8)(u), less);
            found_y = select(found_y, (float8)(v), less);
        }
    }
    float bx[8], by[8];
    vstore8(found_x, 0, bx);
    vstore8(found_y, 0, by);
    for (int i = 0; i < count; ++i)
        best[y * grid.x + x + i] = (float2)(bx[i], by[i]);
}

/* Mean of 3 x 3 pixels. */
__kernel void search_mean(__global const float2 *flow, /* (grid.y, grid.x) */
                          int4 grid,                   /* run size */
                          __global float2 *mean)       /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float2 sum = (float2)(0.0f);
    float weight = 0.0f;
    for (int j = -1; j <= 1; ++j)
        for (int i = -1; i <= 1; ++i) {
            int2 p = (int2)(x + i, y + j);
            if (!grid_border(&p, grid))
                continue;
            sum += flow[p.y * grid.x + p.x];
            weight += 1.0f;
        }
    mean[y * grid.x + x] = sum / weight;
}

/* Index in `cost` of displacement d from a to b at pixel p, or from b to a if `backward`; -1 beyond the grid. */
static inline int search_index(int2 p, int2 d, int4 grid, int2 reach, int backward) {
    if (backward) { /* what b shows at q, a shows at q + d: the cost of -d there */
        p += d;
        d = -d;
        if (!grid_border(&p, grid))
            return -1;
    }
    return (((d.y + reach.y) * (2 * reach.x + 1) + d.x + reach.x) * grid.y + p.y) * grid.x + p.x;
}

/* What was found, where the other direction found the same and nothing else, more than 2 px away, fits nearly as
   well (on what repeats); elsewhere what was there before. */
__kernel void search_agree(__global const float *cost,   /* (displacements, grid.y, grid.x) from a to b */
                           __global const float2 *found, /* (grid.y, grid.x) px, whole numbers within reach */
                           __global const float2 *back,  /* (grid.y, grid.x) px, of the other direction, likewise */
                           __global const float2 *flow,  /* (grid.y, grid.x) px */
                           int4 grid,                    /* run size */
                           int2 reach,                   /* px */
                           int backward,                 /* 1: flow from b to a */
                           float tolerance,              /* px */
                           float distinct,               /* how much more any other displacement costs */
                           __global float2 *agreed)      /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const int2 d = convert_int2(found[at]);
    agreed[at] = flow[at];
    int2 p = (int2)(x, y) + d;
    if (!grid_border(&p, grid))
        return;
    const float2 away = found[at] + back[p.y * grid.x + p.x];
    if (dot(away, away) > tolerance * tolerance)
        return;
    const float limit = cost[search_index((int2)(x, y), d, grid, reach, backward)] + distinct;
    for (int v = -reach.y; v <= reach.y; ++v)
        for (int u = -reach.x; u <= reach.x; ++u) {
            if (max(abs(u - d.x), abs(v - d.y)) <= 2)
                continue;
            const int index = search_index((int2)(x, y), (int2)(u, v), grid, reach, backward);
            if (index >= 0 && cost[index] < limit)
                return;
        }
    agreed[at] = found[at];
}

/* Descriptor at a position between pixels, by its four neighbours; w is 0 unless all that count are known. */
static inline float4 search_sample(__global const float4 *b, int2 corner, float2 t, int4 grid) {
    float4 sum = (float4)(0.0f);
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            int2 p = corner + (int2)(i, j);
            if (grid_border(&p, grid))
                sum += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * b[p.y * grid.x + p.x];
        }
    return sum.w > 0.999f ? sum : (float4)(0.0f);
}

/* Weights of a window, in its rows' order, and their sum: pixels that look like the middle count most, what is not
   known counts nothing. */
static inline float search_weights(__global const float4 *a, int2 at, int4 grid, int radius, float focus,
                                   float *weights) {
    const float middle = a[at.y * grid.x + at.x].x;
    float sum = 0.0f;
    for (int j = -radius; j <= radius; ++j)
        for (int i = -radius; i <= radius; ++i) {
            int2 p = at + (int2)(i, j);
            const bool inside = grid_border(&p, grid);
            const float4 own = inside ? a[p.y * grid.x + p.x] : (float4)(0.0f);
            const float weight = own.w == 0.0f ? 0.0f : exp(-focus * fabs(own.x - middle));
            *weights++ = weight;
            sum += weight;
        }
    return sum;
}

/* Weighted sum of the misfits of a window's row; between pixels of `b`, by fraction t from there on. All are known
   to lie within both grids. */
static inline float search_row_misfit(__global const float4 *a, __global const float4 *b, float2 t, int pitch, int count,
                                      const float *weights, float outside) {
    float4 left = (1.0f - t.y) * b[0] + t.y * b[pitch];
    float sum = 0.0f;
    for (int i = 0; i < count; ++i) {
        const float4 right = (1.0f - t.y) * b[i + 1] + t.y * b[pitch + i + 1];
        const float4 there = (1.0f - t.x) * left + t.x * right;
        left = right;
        if (weights[i] != 0.0f)
            sum += weights[i] * (there.w > 0.999f ? search_misfit(a[i], there, outside) : outside);
    }
    return sum;
}

/* `sum` and the same of a row of 2 radius + 1 pixels around `at`, of which some may lie beyond a grid. */
static inline float search_row_at_border(__global const float4 *a, __global const float4 *b, int2 at, int2 shift,
                                         float2 t, int4 grid, int radius, const float *weights, float outside,
                                         float sum) {
    for (int i = -radius; i <= radius; ++i) {
        const float weight = *weights++;
        int2 p = at + (int2)(i, 0);
        const int2 to = p + shift;
        if (weight == 0.0f)
            continue;
        grid_border(&p, grid);
        sum += weight * search_misfit(a[p.y * grid.x + p.x], search_sample(b, to, t, grid), outside);
    }
    return sum;
}

/* Mean misfit of a window under one flow, or something above `least` if it is more than that. */
static inline float search_window(__global const float4 *a, __global const float4 *b, int2 at, float2 f, int4 grid,
                                  int radius, const float *weights, float total, float outside, float least) {
    const float2 base = floor(f), t = f - base;
    const int2 shift = convert_int2(base), first = at - radius, last = at + radius;
    const int side = 2 * radius + 1;
    /* nearly all windows, and where they are looked for: no border rule is needed */
    const bool inner = min(first.x, first.x + shift.x) >= 0 && max(last.x, last.x + shift.x + 1) < grid.x &&
                       min(first.y, first.y + shift.y) >= 0 && max(last.y, last.y + shift.y + 1) < grid.y;
    float sum = 0.0f;
    for (int j = -radius; j <= radius; ++j, weights += side) {
        const int row = (at.y + j) * grid.x + first.x, there = row + shift.y * grid.x + shift.x;
        if (inner)
            sum += search_row_misfit(a + row, b + there, t, grid.x, side, weights, outside);
        else
            sum = search_row_at_border(a, b, at + (int2)(0, j), shift, t, grid, radius, weights, outside, sum);
        if (sum > least * total * 1.001f) /* by more than rounding could make up for */
            return INFINITY;
    }
    return sum / total;
}

/* Each pixel keeps its flow, or takes over the other field's or one from `step` px beside it in either field, if
   it fits better by more than `patience`. */
__kernel void search_choose(__global const float4 *a,     /* (grid.y, grid.x) descriptors */
                            __global const float4 *b,     /* (grid.y, grid.x) of the other image */
                            __global const float2 *flow,  /* (grid.y, grid.x) px */
                            __global const float2 *other, /* (grid.y, grid.x) px; may be flow itself */
                            int4 grid,                    /* run size */
                            int step,                     /* px */
                            int radius,                   /* px, of the window compared, at most 4 */
                            float focus,                  /* e-folds for a difference of 1 from the middle */
                            float2 outside,               /* misfit where not known: own flow, another */
                            float patience,               /* by how much another must fit better */
                            __global float2 *chosen)      /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float2 own = flow[at];
    float2 best = own;
    if (a[at].w > 0.0f) {
        float weights[SEARCH_WINDOW], total = 0.0f, least = INFINITY;
        const int count = other == flow ? 5 : 10;
        for (int k = 0; k < count; ++k) {
            const int side = k % 5; /* itself, left, right, above, below; Mesa 22 misreads a table of vectors */
            int2 p = (int2)(x, y) + step * (int2)((side == 2) - (side == 1), (side == 4) - (side == 3));
            if (!grid_border(&p, grid))
                continue;
            const float2 f = k < 5 ? flow[p.y * grid.x + p.x] : other[p.y * grid.x + p.x];
            const float2 from_own = f - own, from_best = f - best;
            if (dot(from_own, from_own) < 0.25f || dot(from_best, from_best) < 0.25f)
                continue;
            if (total == 0.0f) { /* nothing is calculated where all agree */
                total = search_weights(a, (int2)(x, y), grid, radius, focus, weights);
                least = search_window(a, b, (int2)(x, y), own, grid, radius, weights, total, outside.x, INFINITY);
                least -= patience;
                if (least <= 0.0f)
                    break; /* nothing fits so much better */
            }
            const float cost = search_window(a, b, (int2)(x, y), f, grid, radius, weights, total, outside.y, least);
            if (cost < least) {
                least = cost;
                best = f;
            }
        }
    }
    chosen[at] = best;
}
