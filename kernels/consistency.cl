/* Where the two flows of a pair are not consistent (there and back does not end at the start) they are not trusted.
   There flow is filled from where it is: coarse to fine, on every level by sweeps that carry it on, but hardly across
   edges of the image. The place of what is taken from one photo is excluded: edges there are its own and tell nothing
   of what is around. */

/* The area that a pixel's has become where its flow leads. Beyond a border that does not wrap flow is the same. */
static inline float consistency_area(__global const float2 *flow, int x, int y, int4 grid) {
    const int at = y * grid.x + x, turn = grid.z ? grid.x - 1 : 0;
    const float2 left = flow[x > 0 ? at - 1 : at + turn], right = flow[x < grid.x - 1 ? at + 1 : at - turn];
    const float2 above = flow[y > 0 ? at - grid.x : at], below = flow[y < grid.y - 1 ? at + grid.x : at];
    const float2 across = 0.5f * (right - left), down = 0.5f * (below - above);
    return (1.0f + across.x) * (1.0f + down.y) - across.y * down.x;
}

/* Trust in a flow, 1 / (1 + (e / tolerance)^2)^4 with e = |F_ab(q) + F_ba(q + F_ab(q))|, and less where it is
   squeezed; none in the place of what is taken from one photo. */
__kernel void consistency_trust(__global const float2 *flow, /* (grid.y, grid.x) F_ab, px */
                                __global const float2 *back, /* (grid.y, grid.x) F_ba, px */
                                int4 grid,                   /* width, height, wraps, 0; run size */
                                float tolerance,             /* px that leave a sixteenth of the trust */
                                float squeezed,              /* area of a pixel that leaves none, as a share */
                                __global const uchar *mask,  /* (cells.y, cells.x): what is taken from one photo */
                                int4 cells,                  /* width, height, px of the chart per cell, 0 */
                                __global const float *image, /* (grid.y, grid.x) a: log brightness, 0 outside */
                                __global float4 *trusted)    /* (grid.y, grid.x) F_ab, trust, brightness */
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
    const float shown = ramp(consistency_area(flow, x, y, grid), squeezed, 1.0f);
    const bool excluded = mask[row * cells.x + column];
    trusted[at] = (float4)(f, excluded ? 0.0f : shown * c * c * c * c, excluded ? EXCLUDED : image[at]);
}

/* Halve: the mean flow, weighted by trust, the mean trust and the mean brightness. */
__kernel void consistency_push(__global const float4 *trusted, /* (fine.y, fine.x) flow, trust, brightness */
                               int4 fine,                      /* width, height, wraps, 0 */
                               __global float4 *small,         /* (size.y, size.x), flow in px of the finest */
                               int2 size)                      /* run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float taps[4] = HALVING_TAPS;
    float2 sum = (float2)(0.0f);
    float trust = 0.0f, brightness = 0.0f, counted = 0.0f, weight = 0.0f;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            int2 p = (int2)(2 * x - 1 + i, 2 * y - 1 + j);
            if (!grid_border(&p, fine))
                continue;
            const float4 f = trusted[p.y * fine.x + p.x];
            const float w = taps[i] * taps[j];
            sum += w * f.z * f.xy;
            trust += w * f.z;
            const float counts = f.w < EXCLUDED ? w : 0.0f;
            brightness += counts * f.w;
            counted += counts;
            weight += w;
        }
    small[y * size.x + x] = (float4)(trust > 0.0f ? sum / trust : (float2)(0.0f), trust / weight,
                                     counted > 0.0f ? brightness / counted : EXCLUDED);
}

/* Less trust, in place, where there is little around: between two wrong flows lies a line on which they happen to
   lead back. */
__kernel void consistency_support(__global const float4 *coarse, /* (size.y, size.x) flow, trust, brightness */
                                  int4 size,                     /* width, height, wraps, 0 */
                                  float times,                   /* finer pixels in the width of one of its */
                                  float enough,                  /* mean trust around that takes nothing away */
                                  __global float4 *trusted,      /* (fine.y, fine.x) flow, trust, brightness */
                                  int4 fine)                     /* width, height, wraps, 0; run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= fine.x || y >= fine.y)
        return;
    int4 at;
    const float4 w = bilinear_taps((float2)(x + 0.5f, y + 0.5f) / times, size, &at);
    const float mean = w.x * coarse[at.x].z + w.y * coarse[at.y].z + w.z * coarse[at.z].z + w.w * coarse[at.w].z;
    const float support = LEAST(mean / enough, 1.0f);
    trusted[y * fine.x + x].z *= support * support;
}

/* The flow alone. */
__kernel void consistency_flow(__global const float4 *trusted, /* (grid.y, grid.x) flow, trust, brightness */
                               int4 grid,                      /* run size */
                               __global float2 *flow)          /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < grid.x && y < grid.y)
        flow[y * grid.x + x] = trusted[y * grid.x + x].xy;
}

/* A level's own flow as far as that is trusted, else the filled coarser one's. */
__kernel void consistency_pull(__global const float4 *trusted, /* (fine.y, fine.x) flow, trust, brightness */
                               int4 fine,                      /* width, height, wraps, 0; run size */
                               __global const float2 *coarse,  /* (size.y, size.x) filled flow */
                               int4 size,                      /* width, height, wraps, 0 */
                               __global float2 *filled)        /* (fine.y, fine.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= fine.x || y >= fine.y)
        return;
    const float4 its = trusted[y * fine.x + x];
    const float2 below = bilinear_flow(coarse, 0.5f * (float2)(x + 0.5f, y + 0.5f), size);
    filled[y * fine.x + x] = its.z * its.xy + (1.0f - its.z) * below;
}

/* How well flow is carried from a pixel to the next, by their brightness: 1 where it is equal. */
static inline float consistency_conductance(float a, float b, float edge) {
    const float d = GREATEST(a, b) < EXCLUDED ? (a - b) / edge : 0.0f;
    return 1.0f / (1.0f + d * d);
}

/* Half a sweep, in place: each pixel of one colour of a chessboard goes to, and beyond, the mean of its own flow,
   which counts by the odds of its trust (finite where that is 1), and its neighbours'. Around a grid of odd width
   pixels of one colour would meet: nothing is carried there. */
__kernel void consistency_relax(__global const float4 *trusted, /* (grid.y, grid.x) flow, trust, brightness */
                                int4 grid,        /* width, height, wraps, 0; run size: half as wide */
                                float own,        /* what a trust of a half counts, against one neighbour */
                                float edge,       /* difference of log brightness that halves what is carried */
                                int colour,       /* 0 or 1 */
                                float relaxation, /* how far to go: 1 to the mean */
                                __global float2 *filled) /* (grid.y, grid.x) */
{
    const int y = get_global_id(1), x = 2 * (int)get_global_id(0) + (y + colour) % 2;
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x, turn = grid.z && grid.x % 2 == 0 ? grid.x : 0;
    const int beside[4] = {x > 0 ? at - 1 : at - 1 + turn, x < grid.x - 1 ? at + 1 : at + 1 - turn,
                           at - grid.x, at + grid.x};
    const bool there[4] = {x > 0 || turn, x < grid.x - 1 || turn, y > 0, y < grid.y - 1};
    const float4 its = trusted[at];
    float weight = own * its.z / (1.001f - its.z);
    float2 sum = weight * its.xy;
    for (int i = 0; i < 4; ++i) {
        const int n = there[i] ? beside[i] : at;
        const float w = there[i] ? consistency_conductance(trusted[n].w, its.w, edge) : 0.0f;
        sum += w * filled[n];
        weight += w;
    }
    const float2 old = filled[at];
    filled[at] = weight > 0.0f ? old + relaxation * (sum / weight - old) : old;
}

/* The flow where it is trusted, else what was filled in, in place. */
__kernel void consistency_mix(__global const float4 *trusted, /* (grid.y, grid.x) flow, trust, brightness */
                              int4 grid,                      /* run size */
                              __global const float2 *wide,    /* (grid.y, grid.x) for what is taken from one photo */
                              __global float2 *filled)        /* (grid.y, grid.x) for all else */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 its = trusted[at];
    const float2 other = its.w < EXCLUDED ? filled[at] : wide[at];
    filled[at] = its.z * its.xy + (1.0f - its.z) * other;
}
