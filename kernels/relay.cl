/* Flow of a pair composed by way of a third layer, and the weights of flows. Found flow: flow in px, trust, brightness,
   as consistency_trust gives them. Cells: squares of so many pixels of a chart, the last ones less. */

/* Deviations of brightness from its mean are limited to this, so that none outweighs the others. */
#define RELAY_MOST 0.3f

/* How flow fits is next to unknown if brightness is known, both here and where flow leads, in less than this share of
   the pixels that are looked at for a cell: as many as the cell has. */
#define RELAY_LITTLE 0.2f

/* Brightness of the pair's other layer where flow leads from pixel p; EXCLUDED where it is not known. */
static inline float relay_seen(__global const float4 *other, int2 p, float2 flow, int4 grid) {
    const float2 q = (float2)(p.x, p.y) + flow;
    const int2 corner = floor_int2(q);
    const float2 t = q - convert_float2(corner);
    float sum = 0.0f;
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            const int at = grid_index(corner + (int2)(i, j), grid);
            const float c = at < 0 ? 0.0f : other[at].w;
            if (c == 0.0f || c >= EXCLUDED)
                return EXCLUDED;
            sum += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * c;
        }
    return sum;
}

/* For the middle of each cell the flow there and its trust, -1 where not both layers show something; and its fit: with
   s^2 the variance of brightness around it, e^2 that of its difference from what the other layer shows where the flows
   lead, ((s^2 + n^2) / (s^2 + n^2 + 2 e^2))^4; -1 where next to nothing is known. */
__kernel void relay_cells(__global const float4 *found, /* (grid.y, grid.x) from layer a to layer b */
                          __global const float4 *other, /* (grid.y, grid.x) from b to a */
                          int4 grid,                    /* width, height, wraps, 0 */
                          int cell,                     /* px in the side of a cell */
                          float noise,                  /* n: of brightness */
                          int2 size,                    /* run size */
                          __global float4 *cells)       /* (size.y, size.x) flow, trust, fit */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const int2 middle = (int2)(LEAST(x * cell + cell / 2, grid.x - 1), LEAST(y * cell + cell / 2, grid.y - 1));
    float known = 0.0f, mean = 0.0f, off = 0.0f, texture = 0.0f, misfit = 0.0f;
    for (int pass = 0; pass < 2; ++pass) {
        for (int j = -cell; j < cell; j += 2) /* every second pixel tells enough */
            for (int i = -cell; i < cell; i += 2) {
                int2 p = middle + (int2)(i, j);
                if (!grid_border(&p, grid))
                    continue;
                const float4 f = found[p.y * grid.x + p.x];
                if (f.w == 0.0f || f.w >= EXCLUDED)
                    continue;
                const float seen = relay_seen(other, p, f.xy, grid), d = f.w - seen;
                if (seen >= EXCLUDED)
                    continue;
                if (pass == 0) {
                    known += 1.0f;
                    mean += f.w;
                    off += d;
                } else {
                    const float s = LIMITED(f.w - mean, -RELAY_MOST, RELAY_MOST);
                    const float e = LIMITED(d - off, -RELAY_MOST, RELAY_MOST);
                    texture += s * s;
                    misfit += e * e;
                }
            }
        if (pass == 0 && known > 0.0f) {
            mean /= known;
            off /= known;
        }
    }
    const float signal = texture + known * noise * noise, fit = signal / (signal + 2.0f * misfit);
    const int at = middle.y * grid.x + middle.x;
    const float4 own = found[at];
    const bool shown = own.w != 0.0f && own.w < EXCLUDED && other[at].w != 0.0f;
    cells[y * size.x + x] = (float4)(own.xy, shown ? own.z : -1.0f,
                                     known < RELAY_LITTLE * cell * cell ? -1.0f : fit * fit * fit * fit);
}

/* Moves position u of a chart to where flow leads from there, in place; returns the weight of that: trust times fit, 0
   beside the chart and where not both layers show something (flow continues there, and is consistent as well). */
static inline float relay_follow(__global const float4 *found, __global const float4 *back,
                                 __global const float4 *cells, int4 grid, int cell, float2 *u) {
    if (!(u->x >= 0.0f && u->y >= 0.0f && u->x < grid.x && u->y < grid.y))
        return 0.0f;
    const int x = (int)u->x, y = (int)u->y, pixel = y * grid.x + x;
    int4 at;
    const float4 taps = bilinear_taps(*u, grid, &at);
    const float4 w = taps * (float4)(found[at.x].z, found[at.y].z, found[at.z].z, found[at.w].z);
    const float trust = w.x + w.y + w.z + w.w;
    if (found[pixel].w == 0.0f || back[pixel].w == 0.0f || trust <= 0.0f)
        return 0.0f;
    *u += (w.x * found[at.x].xy + w.y * found[at.y].xy + w.z * found[at.z].xy + w.w * found[at.w].xy) / trust;
    return trust * cells[y / cell * ((grid.x + cell - 1) / cell) + x / cell].w;
}

/* Add the flow from a to c composed by way of b, F_ab(q) and then F_bc where that leads, at every step-th pixel of
   their chart, times the weights of both. */
__kernel void relay_add(__global const float4 *first,        /* (first_grid.y, first_grid.x) found, from a to b */
                        __global const float4 *first_back,   /* (first_grid.y, first_grid.x) from b to a */
                        __global const float4 *first_cells,  /* of relay_cells */
                        int4 first_grid, float16 first_chart,
                        __global const float4 *second,       /* (second_grid.y, second_grid.x) from b to c */
                        __global const float4 *second_back, __global const float4 *second_cells,
                        int4 second_grid, float16 second_chart,
                        int cell,
                        int4 grid, float16 chart,            /* of a and c */
                        int step, int2 size,                 /* run size */
                        float share,                         /* another weight */
                        __global float4 *sum) /* (size.y, size.x) weighted flow, px of their chart, and weights */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const int2 p = (int2)(LEAST(x * step + step / 2, grid.x - 1), LEAST(y * step + step / 2, grid.y - 1));
    const float2 from = convert_float2(p) + 0.5f;
    float2 u = chart_position(chart_point(from, &chart), &first_chart);
    float weight = share * relay_follow(first, first_back, first_cells, first_grid, cell, &u);
    if (weight <= 0.0f)
        return;
    u = chart_position(chart_point(u, &first_chart), &second_chart);
    weight *= relay_follow(second, second_back, second_cells, second_grid, cell, &u);
    if (weight <= 0.0f)
        return;
    float2 way = chart_position(chart_point(u, &second_chart), &chart) - from;
    way.x -= whole_turns(way.x, (chart.sd != 0.0f ? 2.0f * M_PI_F : chart.se) * chart.s9);
    sum[y * size.x + x] += (float4)(weight * way, weight, 0.0f);
}

/* How two flows agree whose ends lie so far apart: 1, or 1/4 where that is `agrees` px. */
static inline float relay_agreement(float2 off, float agrees) {
    const float a = 1.0f + square2(off) / (agrees * agrees);
    return 1.0f / (a * a);
}

/* How far control points hold found flow, 0..1, into the last component of a sum: the largest product of how near a
   point is and of how flow agrees with its move. */
__kernel void relay_hold(__global const float4 *points, /* (count) place, move, px of the chart */
                         int count,
                         float sigma,                   /* px */
                         float agrees,                  /* px */
                         __global const float4 *found,  /* (grid.y, grid.x) */
                         int4 grid,                     /* run size */
                         __global float4 *sum)          /* (grid.y, grid.x) of relay_add, with a step of 1 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    float most = 0.0f;
    for (int i = 0; i < count; ++i) {
        float2 way = (float2)(x + 0.5f, y + 0.5f) - points[i].xy;
        way.x -= whole_turns(way.x, grid.z ? grid.x : 0.0f);
        const float near = exp(-0.5f * square2(way) / (sigma * sigma));
        most = GREATEST(most, near * relay_agreement(found[at].xy - points[i].zw, agrees));
    }
    sum[at].w = most;
}

/* Found flow is replaced, in place, by composed flow where there is any, and found flow leads elsewhere or is not
   trusted; not where control points hold it, as far as it is trusted, nor where it is excluded. */
__kernel void relay_take(__global const float4 *sum, /* (grid.y, grid.x) of relay_add, with a step of 1 */
                         int4 grid,                  /* run size */
                         float enough,               /* weight of composed flow from which on it is sure */
                         float agrees,               /* px between both that leave a quarter of their agreement */
                         float counts,               /* weight of found flow's trust: 0 or 1 */
                         __global float4 *found)     /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 its = sum[at], own = found[at];
    if (own.w >= EXCLUDED)
        return;
    const float held = its.w * own.z, sure = (1.0f - held) * LEAST(its.z / enough, 1.0f);
    const float2 other = its.z > 0.0f ? its.xy / its.z : own.xy;
    const float agreement = relay_agreement(other - own.xy, agrees);
    const float kept = GREATEST(counts, its.w) * own.z * (1.0f - sure * (1.0f - agreement));
    const float taken = sure * (1.0f - kept);
    if (taken > 0.0f)
        found[at].xy = (kept * own.xy + taken * other) / (kept + taken);
    found[at].z = kept + taken;
}
