/* Where the two flows of a pair do not lead back to the start they are not to be trusted; there flow is filled
   from where it is. */

/* Trust in a flow, 1 / (1 + (e / tolerance)^2)^2 with e = |F_ab(q) + F_ba(q + F_ab(q))|; none in that of what
   moved by itself. */
__kernel void consistency_trust(__global const float2 *flow, /* (grid.y, grid.x) F_ab, px */
                                __global const float2 *back, /* (grid.y, grid.x) F_ba, px */
                                int4 grid,                   /* width, height, wraps, 0; run size */
                                float tolerance,             /* px that leave a quarter of the trust */
                                __global const uchar *moved, /* (cells.y, cells.x): what moved by itself */
                                int4 cells,                  /* width, height, px of the chart per cell, 0 */
                                __global float4 *trusted)    /* (grid.y, grid.x) F_ab, trust, 0 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float2 f = flow[at];
    float2 q = (float2)(x + 0.5f, y + 0.5f) + f;
    /* what leaves the grid comes back as it does at the border */
    q.y = LIMITED(q.y, 0.5f, grid.y - 0.5f);
    if (!grid.z)
        q.x = LIMITED(q.x, 0.5f, grid.x - 0.5f);
    const float2 e = (f + bilinear_flow(back, q, grid)) / tolerance;
    const float c = 1.0f / (1.0f + square2(e));
    const int column = LEAST(x / cells.z, cells.x - 1), row = LEAST(y / cells.z, cells.y - 1);
    trusted[at] = (float4)(f, moved[row * cells.x + column] ? 0.0f : c * c, 0.0f);
}

/* Halve: the mean flow, weighted by trust, and the mean trust; taps as in pyramid_reduce. */
__kernel void consistency_push(__global const float4 *trusted, /* (fine.y, fine.x) flow, trust, 0 */
                               int4 fine,                      /* width, height, wraps, 0 */
                               __global float4 *small,         /* (size.y, size.x), flow in px of the finest */
                               int2 size)                      /* run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float taps[4] = {0.125f, 0.375f, 0.375f, 0.125f};
    float2 sum = (float2)(0.0f);
    float trust = 0.0f, weight = 0.0f;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            int2 p = (int2)(2 * x - 1 + i, 2 * y - 1 + j);
            if (!grid_border(&p, fine))
                continue;
            const float4 f = trusted[p.y * fine.x + p.x];
            const float w = taps[i] * taps[j];
            sum += w * f.z * f.xy;
            trust += w * f.z;
            weight += w;
        }
    small[y * size.x + x] = (float4)(trust > 0.0f ? sum / trust : (float2)(0.0f), trust / weight, 0.0f);
}

/* Give a level, in place, from the filled coarser one what it does not trust itself. */
__kernel void consistency_pull(__global float4 *trusted,      /* (fine.y, fine.x) flow, trust, 0: flow is mended */
                               int4 fine,                     /* width, height, wraps, 0; run size */
                               __global const float4 *coarse, /* (size.y, size.x) */
                               int4 size)                     /* width, height, wraps, 0 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= fine.x || y >= fine.y)
        return;
    const float4 own = trusted[y * fine.x + x];
    int4 at;
    const float4 w = bilinear_taps(0.5f * (float2)(x + 0.5f, y + 0.5f), size, &at);
    const float4 sum = w.x * coarse[at.x] + w.y * coarse[at.y] + w.z * coarse[at.z] + w.w * coarse[at.w];
    trusted[y * fine.x + x].xy = own.z * own.xy + (1.0f - own.z) * sum.xy;
}

/* The flow alone. */
__kernel void consistency_flow(__global const float4 *trusted, /* (grid.y, grid.x) flow, trust, 0 */
                               int4 grid,                      /* run size */
                               __global float2 *flow)          /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < grid.x && y < grid.y)
        flow[y * grid.x + x] = trusted[y * grid.x + x].xy;
}
