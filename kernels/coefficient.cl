/* Distances and blend coefficients. Distances are found on a mask grid by jump flooding (Rong and Tan 2006):
   every pixel learns the nearest seed from neighbours at halving steps. */

/* 1 where every working pixel that a mask pixel touches is valid. */
__kernel void coefficient_mask(__global const float4 *layer, /* (box.w, box.z) r, g, b, valid */
                               int4 box,                     /* place of `layer` on the working grid */
                               int4 working,                 /* working grid */
                               int4 grid,                    /* mask grid, over the same region; run size */
                               __global uchar *mask)         /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    bool valid = true;
    for (int j = y * working.y / grid.y; j * grid.y < (y + 1) * working.y; ++j)
        for (int i = x * working.x / grid.x; i * grid.x < (x + 1) * working.x; ++i) {
            const int at = box_index((int2)(i, j), box);
            valid = valid && at >= 0 && layer[at].w != 0.0f;
        }
    mask[y * grid.x + x] = valid;
}

/* Seeds of D_k: the union's pixels that layer k does not cover, packed as x + 65536 y; -1 elsewhere. */
__kernel void coefficient_seed(__global const uchar *mask,  /* (grid.y, grid.x) of layer k */
                               __global const uchar *cover, /* (grid.y, grid.x) union */
                               int4 grid,                   /* run size */
                               __global int *seed)          /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    seed[at] = cover[at] && !mask[at] ? x + (y << 16) : -1;
}

/* A measure that grows with the distance of two mask pixels; coefficient_distance makes it one. The table holds
   a vertical part by |dy| (grid.y), a horizontal part by |dx| (grid.x) and a factor per row (grid.y). On a
   plane: dy, dx, 1, hence the squared distance. On the sphere: sin(dlat / 2), sin(dlon / 2), cos(lat), hence the
   haversine, which is exact for small angles. */
static inline float coefficient_measure(int2 p, int2 q, int4 grid, __global const float *table) {
    int dx = MAGNITUDE(p.x - q.x);
    if (grid.z)
        dx = LEAST(dx, grid.x - dx);
    const float u = table[MAGNITUDE(p.y - q.y)], v = table[grid.y + dx];
    __global const float *row = table + grid.x + grid.y;
    return u * u + row[p.y] * row[q.y] * v * v;
}

__kernel void coefficient_flood(__global const int *seed,    /* (grid.y, grid.x) packed */
                                int4 grid,                   /* run size */
                                __global const float *table, /* see coefficient_measure */
                                int step,
                                __global int *flooded) /* (grid.y, grid.x) packed */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    if (seed[y * grid.x + x] == x + (y << 16)) { /* a seed itself: nothing is nearer */
        flooded[y * grid.x + x] = x + (y << 16);
        return;
    }
    const bool inner = x >= step && y >= step && x + step < grid.x && y + step < grid.y;
    int best = -1;
    float nearest = INFINITY;
    for (int j = -step; j <= step; j += step)
        for (int i = -step; i <= step; i += step) {
            int2 p = (int2)(x + i, y + j);
            if (!inner && !grid_border(&p, grid))
                continue;
            const int s = seed[p.y * grid.x + p.x];
            if (s < 0 || s == best)
                continue;
            const float d = coefficient_measure((int2)(x, y), (int2)(s & 0xffff, s >> 16), grid, table);
            if (d < nearest || (d == nearest && s < best)) {
                nearest = d;
                best = s;
            }
        }
    flooded[y * grid.x + x] = best;
}

/* D_k in working pixels: 0 outside the layer, `furthest` where the union has nothing outside it. */
__kernel void coefficient_distance(__global const int *seed,   /* (grid.y, grid.x) packed */
                                   __global const uchar *mask, /* (grid.y, grid.x) */
                                   int4 grid,                  /* run size */
                                   __global const float *table, /* see coefficient_measure */
                                   int spherical,
                                   float unit,               /* working px per mask px, or per radian */
                                   float furthest,           /* working px */
                                   __global float *distance) /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x, s = seed[at];
    float d = 0.0f;
    if (mask[at] && s < 0)
        d = furthest;
    else if (mask[at]) {
        const float root = ROOT(coefficient_measure((int2)(x, y), (int2)(s & 0xffff, s >> 16), grid, table));
        d = unit * (spherical ? 2.0f * asin(LEAST(root, 1.0f)) : root);
    }
    distance[at] = d;
}

/* D_k on the working grid, bilinear; never 0 on a valid pixel, so that a lone layer has coefficient 1. */
__kernel void coefficient_expand(__global const float *distance, /* (grid.y, grid.x) */
                                 int4 grid, float2 ratio,        /* mask grid; mask px per working px */
                                 __global const float4 *layer,   /* (box.w, box.z) */
                                 int4 box,                       /* place on the working grid; run size */
                                 int4 working,                   /* working grid */
                                 __global float *expanded,       /* (box.w, box.z) */
                                 __global float *total)          /* (working.y, working.x) sum over layers */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    float d = 0.0f;
    if (layer[at].w != 0.0f) {
        const float2 q = ((float2)(x + box.x, y + box.y) + 0.5f) * ratio;
        d = bilinear_scalar(distance, q, grid);
        d = GREATEST(d, 1e-3f);
    }
    expanded[at] = d;
    total[(y + box.y) * working.x + x + box.x] += d;
}

/* What layers have at a place as parts of the sum of all, in place: w_k = D_k / sum_j D_j. */
__kernel void coefficient_ratio(__global float *value,        /* (box.w, box.z), 0 or more; stays where the sum is 0 */
                                int4 box, int4 grid,          /* place, run size; its grid */
                                __global const float *total)  /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float sum = total[(y + box.y) * grid.x + x + box.x];
    if (sum > 0.0f)
        value[y * box.z + x] /= sum;
}
