/* Large motion: every displacement within reach is tried on a coarse level (after Steinbrücker, Pock, Cremers
   2009: costs and smoothness are coupled by a quadratic term and minimised in turns); there and on finer levels
   each pixel takes over a flow from beside it where that fits better (after Barnes et al. 2009).

   A descriptor is (h, dh/dx, dh/dy, valid), divided by how strongly its neighbourhood varies: the same in bright
   and dark, sharp and dull places. Flow is in pixels of the level's grid; grid = (width, height, wraps, 0).
   Descriptors lie by rows and components, each of `wide` columns, of which SEARCH_MARGIN are before the grid's first
   one and as many or more behind its last: there is what is beside the border where the grid wraps, else nothing known.
   A displacement has the index (d.y + reach.y) * (2 reach.x + 1) + d.x + reach.x. The costs of a row lie together, by
   displacement, in columns of which the first grid.x count: what is tried at a pixel is near in memory. */

#define SEARCH_SLOPE 1.5f /* weight of the derivatives beside h */
#define SEARCH_UNLIKE 0.5f /* squared difference of descriptors that is half a misfit */
#define SEARCH_MARGIN 16  /* more than a reach, and no less than SEARCH_ROW */
#define SEARCH_RADIUS 4   /* px, of the largest window in which flows are compared */
#define SEARCH_ROW 16     /* columns of a window's row: they are compared eight at a time */

/* Sums of squares of features, and of what is known, over seven pixels of a row. */
__kernel void search_energy(__global const float4 *feature, /* (grid.y, grid.x) kernels/flow.cl */
                            int4 grid,                      /* run size */
                            __global float2 *energy)        /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float2 sum = (float2)(0.0f);
    for (int i = -3; i <= 3; ++i) {
        int2 p = (int2)(x + i, y);
        if (!grid_border(&p, grid))
            continue;
        const float4 f = feature[p.y * grid.x + p.x];
        sum += (float2)(f.w * (f.x * f.x + SEARCH_SLOPE * SEARCH_SLOPE * (f.y * f.y + f.z * f.z)), f.w);
    }
    energy[y * grid.x + x] = sum;
}

/* Features over the root of their mean square in 7 x 7 pixels. */
__kernel void search_descriptor(__global const float4 *feature, /* (grid.y, grid.x) kernels/flow.cl */
                                __global const float2 *energy,  /* (grid.y, grid.x) of search_energy */
                                int4 grid,                      /* run size */
                                float noise,                    /* amplitude of h that is no texture */
                                __global float4 *descriptor)    /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float2 sum = (float2)(0.0f);
    for (int j = -3; j <= 3; ++j) {
        int2 p = (int2)(x, y + j);
        if (grid_border(&p, grid))
            sum += energy[p.y * grid.x + p.x];
    }
    const float4 f = feature[y * grid.x + x];
    const float scale = 1.0f / (sqrt(sum.x / fmax(sum.y, 1.0f)) + noise);
    descriptor[y * grid.x + x] = (float4)(f.x * scale, SEARCH_SLOPE * scale * f.yz, f.w);
}

/* Descriptors by component, with margins. */
__kernel void search_planes(__global const float4 *descriptor, /* (grid.y, grid.x) */
                            int4 grid,
                            int wide,                          /* run size: (wide, grid.y) */
                            __global float *planes)            /* (grid.y, 4, wide) */
{
    const int column = get_global_id(0), y = get_global_id(1);
    if (column >= wide || y >= grid.y)
        return;
    int2 p = (int2)(column - SEARCH_MARGIN, y);
    const float4 d = grid_border(&p, grid) ? descriptor[p.y * grid.x + p.x] : (float4)(0.0f);
    __global float *to = planes + 4 * y * wide + column;
    to[0] = d.x;
    to[wide] = d.y;
    to[2 * wide] = d.z;
    to[3 * wide] = d.w;
}

/* The first component of the descriptors of row y, from column x on; the others are `wide` columns further each. */
static inline __global const float *search_place(__global const float *descriptor, int x, int y, int wide) {
    return descriptor + 4 * y * wide + SEARCH_MARGIN + x;
}

/* How badly eight descriptors, given by component, fit others that are known. */
static inline float8 search_misfit(float8 a0, float8 a1, float8 a2, float8 b0, float8 b1, float8 b2) {
    const float8 d0 = a0 - b0, d1 = a1 - b1, d2 = a2 - b2, e = d0 * d0 + d1 * d1 + d2 * d2;
    return e / (e + SEARCH_UNLIKE);
}

/* Eight pixels of one row: x of the first one, in whole eights, and the row, of rows of so many eights. */
static inline int2 search_eight(int eights) {
    const int item = get_global_id(0), row = item / eights;
    return (int2)(8 * (item - row * eights), row);
}

/* Misfit of each pixel, and of those beside the grid's borders, under each displacement; -1 where the first image is
   not known. Eight pixels at a time. */
__kernel void search_pixel_cost(__global const float *a, /* (grid.y, 4, wide) descriptors */
                                __global const float *b, /* (grid.y, 4, wide) of the other image */
                                int4 grid,
                                int2 reach,              /* largest displacement, px, less than SEARCH_MARGIN */
                                int wide,
                                float outside,           /* misfit where one of both is not known */
                                int pitch,               /* run size: pitch / 8 x displacements x grid.y */
                                __global float *cost)    /* (grid.y, displacements, pitch), from x = -1 on */
{
    const int span = 2 * reach.x + 1, count = span * (2 * reach.y + 1);
    const int2 eight = search_eight(pitch / 8);
    const int x = eight.x - 1, row = eight.y;
    const int y = row / count, index = row - y * count, there = y + index / span - reach.y;
    if (y >= grid.y)
        return;
    __global const float *own = search_place(a, x, y, wide);
    const float8 known = vload8(0, own + 3 * wide);
    float8 misfit = (float8)(outside);
    if (there >= 0 && there < grid.y) {
        __global const float *other = search_place(b, x + index % span - reach.x, there, wide);
        const float8 found = search_misfit(vload8(0, own), vload8(0, own + wide), vload8(0, own + 2 * wide),
                                           vload8(0, other), vload8(0, other + wide), vload8(0, other + 2 * wide));
        misfit = known * vload8(0, other + 3 * wide) > 0.0f ? found : misfit;
    }
    vstore8(known > 0.0f ? misfit : (float8)(-1.0f), 0, cost + row * pitch + eight.x);
}

/* Mean over what is known of 3 x 3 pixels, under each displacement; eight pixels at a time. */
__kernel void search_cost(__global const float *pixel_cost, /* (grid.y, displacements, pitch) of search_pixel_cost */
                          int4 grid,                        /* run size: ceil(grid.x / 8) x displacements x grid.y */
                          int displacements,
                          float outside,                    /* cost where none is known */
                          int pitch,                        /* at least 8 more than grid.x, in whole eights */
                          __global float *cost)             /* (grid.y, displacements, pitch) */
{
    const int2 eight = search_eight((grid.x + 7) / 8);
    const int x = eight.x, row = eight.y, y = row / displacements;
    if (y >= grid.y)
        return;
    float8 sum = (float8)(0.0f), weight = (float8)(0.0f);
    for (int j = y > 0 ? -1 : 0; j <= (y + 1 < grid.y ? 1 : 0); ++j)
        for (int i = 0; i < 3; ++i) {
            const float8 c = vload8(0, pixel_cost + (row + j * displacements) * pitch + x + i);
            sum += c >= 0.0f ? c : (float8)(0.0f);
            weight += c >= 0.0f ? (float8)(1.0f) : (float8)(0.0f);
        }
    vstore8(weight > 0.0f ? sum / weight : (float8)(outside), 0, cost + row * pitch + x);
}

/* The displacement that costs least, with what it is away from `flow`; eight pixels at a time. No cost is below 0, so
   what is so far away from all eight that this alone is more than they pay next to their flow is not tried. */
__kernel void search_best(__global const float *cost,  /* (grid.y, displacements, pitch) of this direction */
                          __global const float2 *flow, /* (grid.y, grid.x) px, finite */
                          int4 grid,                   /* run size: ceil(grid.x / 8) x grid.y */
                          int2 reach,                  /* px */
                          float coupling,              /* cost of a squared pixel away from flow */
                          int pitch,
                          __global float2 *best)       /* (grid.y, grid.x) px */
{
    const int2 eight = search_eight((grid.x + 7) / 8);
    const int x = eight.x, y = eight.y, count = LEAST(8, grid.x - x), span = 2 * reach.x + 1;
    if (y >= grid.y)
        return;
    cost += y * (2 * reach.y + 1) * span * pitch + x;
    const float2 furthest = convert_float2(reach);
    float2 first = (float2)(INFINITY), last = (float2)(-INFINITY); /* flow of the eight */
    float near_x[8], near_y[8], most = 0.0f;
    for (int i = 0; i < 8; ++i) {
        const int lane = LEAST(i, count - 1);
        const float2 near = flow[y * grid.x + x + lane], whole = LIMITED(rint(near), -furthest, furthest);
        const float2 away = whole - near;
        const int2 place = convert_int2(whole) + reach;
        const float pays = cost[(place.y * span + place.x) * pitch + lane] + coupling * square2(away);
        most = GREATEST(most, pays);
        first = LEAST(first, near);
        last = GREATEST(last, near);
        near_x[i] = near.x;
        near_y[i] = near.y;
    }
    const float8 from_x = vload8(0, near_x), from_y = vload8(0, near_y);
    /* by more than rounding could make up for; without a coupling, all but what would gain less than that */
    const float2 within = (float2)(1.001f * ROOT(most / GREATEST(coupling, 1e-9f)) + 0.001f);
    const int2 low = convert_int2(GREATEST(ceil(first - within), -furthest));
    const int2 high = convert_int2(LEAST(floor(last + within), furthest));
    float8 least = (float8)(INFINITY);
    int8 found = (int8)(0);
    for (int v = low.y; v <= high.y; ++v) {
        const float8 away_y = (float)v - from_y, down = away_y * away_y;
        int index = (v + reach.y) * span + low.x + reach.x;
        for (int u = low.x; u <= high.x; ++u, ++index) {
            const float8 away_x = (float)u - from_x;
            const float8 total = vload8(0, cost + index * pitch) + coupling * (away_x * away_x + down);
            const int8 less = total < least; /* `select` would take one after the other on PoCL */
            least = less ? total : least;
            found = less ? (int8)(index) : found;
        }
    }
    int lanes[8];
    vstore8(found, 0, lanes);
    for (int i = 0; i < count; ++i)
        best[y * grid.x + x + i] = (float2)(lanes[i] % span - reach.x, lanes[i] / span - reach.y);
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

/* Whether nothing else, more than 2 px away, fits nearly as well as what was found (on what repeats). */
__kernel void search_distinct(__global const float *cost,   /* (grid.y, displacements, pitch) of this direction */
                              __global const float2 *found, /* (grid.y, grid.x) px, whole numbers within reach */
                              int4 grid,                    /* run size */
                              int2 reach,                   /* px */
                              float more,                   /* how much more any other displacement costs */
                              int pitch,
                              __global uchar *distinct)     /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x, span = 2 * reach.x + 1;
    const int2 d = convert_int2(found[at]);
    cost += y * span * (2 * reach.y + 1) * pitch + x;
    const float limit = cost[((d.y + reach.y) * span + d.x + reach.x) * pitch] + more;
    distinct[at] = 0;
    for (int v = -reach.y; v <= reach.y; ++v)
        for (int u = -reach.x; u <= reach.x; ++u, cost += pitch)
            if (*cost < limit && max(abs(u - d.x), abs(v - d.y)) > 2)
                return;
    distinct[at] = 1;
}

/* What was found, where that is distinct and the other direction found the same; elsewhere what was there before. */
__kernel void search_agree(__global const float2 *found,   /* (grid.y, grid.x) px, whole numbers */
                           __global const float2 *back,    /* (grid.y, grid.x) px, of the other direction, likewise */
                           __global const uchar *distinct, /* (grid.y, grid.x) of search_distinct */
                           __global const float2 *flow,    /* (grid.y, grid.x) px */
                           int4 grid,                      /* run size */
                           float tolerance,                /* px */
                           __global float2 *agreed)        /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    int2 p = (int2)(x, y) + convert_int2(found[at]);
    bool agrees = distinct[at] && grid_border(&p, grid);
    if (agrees) {
        const float2 away = found[at] + back[p.y * grid.x + p.x];
        agrees = dot(away, away) <= tolerance * tolerance;
    }
    agreed[at] = agrees ? found[at] : flow[at];
}

/* Weights of a window, by rows of SEARCH_ROW, and their sum: pixels that look like the middle count most, what is not
   known counts nothing. */
static inline float search_weights(__global const float *a, int2 at, int4 grid, int wide, int radius, float focus,
                                   float *weights) {
    const int side = 2 * radius + 1;
    const float middle = *search_place(a, at.x, at.y, wide);
    float sum = 0.0f;
    for (int j = -radius; j <= radius; ++j, weights += SEARCH_ROW) {
        const int y = at.y + j;
        __global const float *own = search_place(a, at.x - radius, y, wide);
        for (int i = 0; i < side; i += 8) {
            float8 weight = (float8)(0.0f);
            if (y >= 0 && y < grid.y) {
                const float8 looks = exp(-focus * fabs(vload8(0, own + i) - middle));
                weight = vload8(0, own + 3 * wide + i) != 0.0f ? looks : weight;
            }
            vstore8(weight, 0, weights + i);
        }
        for (int i = 0; i < side; ++i)
            sum += weights[i];
    }
    return sum;
}

/* Eight values of a component: between two rows by their shares, and between columns by t. */
static inline float8 search_between(__global const float *upper, __global const float *lower, float2 shares, float t) {
    const float8 left = shares.x * vload8(0, upper) + shares.y * vload8(0, lower);
    const float8 right = shares.x * vload8(0, upper + 1) + shares.y * vload8(0, lower + 1);
    return (1.0f - t) * left + t * right;
}

/* Weighted sum of the misfits of a window's row and what lies between two of the other image. */
static inline float search_row(__global const float *own, __global const float *upper, __global const float *lower,
                               float2 shares, float t, int wide, int side, const float *weights, float outside) {
    float sum = 0.0f;
    for (int i = 0; i < side; i += 8, own += 8, upper += 8, lower += 8) {
        const float8 b0 = search_between(upper, lower, shares, t);
        const float8 b1 = search_between(upper + wide, lower + wide, shares, t);
        const float8 b2 = search_between(upper + 2 * wide, lower + 2 * wide, shares, t);
        const float8 known = search_between(upper + 3 * wide, lower + 3 * wide, shares, t);
        const float8 a0 = vload8(0, own), a1 = vload8(0, own + wide), a2 = vload8(0, own + 2 * wide);
        const float8 found = search_misfit(a0, a1, a2, b0, b1, b2);
        float misfits[8];
        vstore8(known > 0.999f ? found : (float8)(outside), 0, misfits);
        for (int k = 0; k < 8 && i + k < side; ++k)
            sum += weights[i + k] * misfits[k];
    }
    return sum;
}

/* Mean misfit of a window under one flow, or something above `least` if it is more than that. */
static inline float search_window(__global const float *a, __global const float *b, int2 at, float2 f, int4 grid,
                                  int wide, int radius, const float *weights, float total, float outside,
                                  float least) {
    const float2 base = floor(f), t = f - base;
    const int side = 2 * radius + 1, above = at.y + (int)base.y - radius;
    /* columns beside the grid are all unknown: a window there may as well lie next to it, in the margins */
    int left = at.x + (int)base.x - radius;
    left = grid.z ? (left % grid.x + grid.x) % grid.x : LIMITED(left, -SEARCH_MARGIN, grid.x);
    float sum = 0.0f;
    for (int j = 0; j < side; ++j, weights += SEARCH_ROW) {
        /* of its own rows those beyond the grid have no weight: any will do */
        const int own = LIMITED(at.y - radius + j, 0, grid.y - 1), y = above + j;
        const float2 shares =
            (float2)(y >= 0 && y < grid.y ? 1.0f - t.y : 0.0f, y + 1 >= 0 && y + 1 < grid.y ? t.y : 0.0f);
        sum += search_row(search_place(a, at.x - radius, own, wide),
                          search_place(b, left, LIMITED(y, 0, grid.y - 1), wide),
                          search_place(b, left, LIMITED(y + 1, 0, grid.y - 1), wide), shares, t.x, wide, side,
                          weights, outside);
        if (sum > least * total * 1.001f) /* by more than rounding could make up for */
            return INFINITY;
    }
    return sum / total;
}

/* 0 to 4: itself, left, right, above, below; Mesa 22 misreads a table of vectors. */
static inline int2 search_side(int side) {
    return (int2)((side == 2) - (side == 1), (side == 4) - (side == 3));
}

/* Each pixel keeps its flow, or takes over the other field's or one from `step` px beside it in either field, if
   it fits better by more than `patience`. */
__kernel void search_choose(__global const float *a,      /* (grid.y, 4, wide) descriptors */
                            __global const float *b,      /* (grid.y, 4, wide) of the other image */
                            __global const float2 *flow,  /* (grid.y, grid.x) px */
                            __global const float2 *other, /* (grid.y, grid.x) px; may be flow itself */
                            int4 grid,                    /* run size */
                            int wide,
                            int step,                     /* px */
                            int radius,                   /* px, of the window compared, at most SEARCH_RADIUS */
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
    if (search_place(a, x, y, wide)[3 * wide] > 0.0f) {
        float weights[(2 * SEARCH_RADIUS + 1) * SEARCH_ROW], total = 0.0f, least = INFINITY;
        const int count = other == flow ? 5 : 10;
        for (int k = 0; k < count; ++k) {
            int2 p = (int2)(x, y) + step * search_side(k % 5);
            if (!grid_border(&p, grid))
                continue;
            const float2 f = k < 5 ? flow[p.y * grid.x + p.x] : other[p.y * grid.x + p.x];
            const float2 from_own = f - own, from_best = f - best;
            if (dot(from_own, from_own) < 0.25f || dot(from_best, from_best) < 0.25f)
                continue;
            if (total == 0.0f) { /* nothing is calculated where all agree */
                total = search_weights(a, (int2)(x, y), grid, wide, radius, focus, weights);
                least = search_window(a, b, (int2)(x, y), own, grid, wide, radius, weights, total, outside.x, INFINITY);
                least -= patience;
                if (least <= 0.0f)
                    break; /* nothing fits so much better */
            }
            const float cost =
                search_window(a, b, (int2)(x, y), f, grid, wide, radius, weights, total, outside.y, least);
            if (cost < least) {
                least = cost;
                best = f;
            }
        }
    }
    chosen[at] = best;
}

/* Where flow is not trusted, that of a trusted pixel `step` px beside it, if that fits, and so much better. */
__kernel void search_adopt(__global const float *a,        /* (grid.y, 4, wide) descriptors */
                           __global const float *b,        /* (grid.y, 4, wide) of the other image */
                           __global const float4 *trusted, /* (grid.y, grid.x) flow, px, trust, brightness */
                           int4 grid,                      /* run size */
                           int wide,
                           int step,                       /* px */
                           int radius,                     /* px, as for search_choose */
                           float focus, float2 outside,    /* likewise */
                           float patience,                 /* by how much another must fit better */
                           float most,                     /* the misfit from which on nothing fits */
                           float enough,                   /* trust from which on flow is trusted */
                           __global float4 *adopted)       /* the same; what is taken over is trusted as much */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 own = trusted[at];
    float4 best = own;
    if (own.z < enough && search_place(a, x, y, wide)[3 * wide] > 0.0f) {
        float weights[(2 * SEARCH_RADIUS + 1) * SEARCH_ROW], total = 0.0f, least = INFINITY;
        for (int side = 1; side < 5; ++side) {
            int2 p = (int2)(x, y) + step * search_side(side);
            if (!grid_border(&p, grid))
                continue;
            const float4 f = trusted[p.y * grid.x + p.x];
            if (f.z < enough)
                continue;
            if (total == 0.0f) {
                total = search_weights(a, (int2)(x, y), grid, wide, radius, focus, weights);
                least =
                    search_window(a, b, (int2)(x, y), own.xy, grid, wide, radius, weights, total, outside.x, INFINITY);
                least = LEAST(least - patience, most);
                if (least <= 0.0f)
                    break; /* nothing fits so much better */
            }
            const float cost =
                search_window(a, b, (int2)(x, y), f.xy, grid, wide, radius, weights, total, outside.y, least);
            if (cost < least) {
                least = cost;
                best = (float4)(f.xy, enough, own.w);
            }
        }
    }
    adopted[at] = best;
}
