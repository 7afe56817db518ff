/* Guides steer the flow of one pair: a second start, which the guides displace, and the choice between what
   comes of it and the flow found without them.

   A guide is (x, y, rx, ry): its place and how far it is from the flow found alone, px of the chart. Flow is
   in pixels of the level's grid; grid = (width, height, wraps, 0). `near` is 1 at a guide and falls to 0. */

/* How much of the flow around guides is theirs: all of it up to 1.2 sigma, nothing beyond 4. */
static inline float guidance_share(float near) {
    return clamp(2.0f * near - 1e-3f, 0.0f, 1.0f);
}

/* The flow on a coarser level, displaced by an interpolation of the guides' residuals. */
__kernel void guidance_start(__global const float2 *flow,   /* (grid.y, grid.x) px of the chart */
                             int4 grid,                     /* of the chart */
                             __global const float4 *guides, /* (count) */
                             __global const float *sigmas,  /* (count) px of the chart */
                             int count,
                             float scale,                   /* chart pixels per pixel of the level */
                             __global float2 *start,        /* (size.y, size.x) px of the level */
                             __global float *near,          /* (size.y, size.x) */
                             int2 size)                     /* of the level; run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float2 q = scale * (float2)(x + 0.5f, y + 0.5f);
    float2 sum = (float2)(0.0f);
    float total = 0.0f, nearest = 0.0f;
    for (int i = 0; i < count; ++i) {
        const float4 guide = guides[i];
        float2 way = q - guide.xy;
        way.x -= whole_turns(way.x, grid.z ? grid.x : 0.0f);
        const float g = exp(-0.5f * dot(way, way) / (sigmas[i] * sigmas[i]));
        sum += g * guide.zw;
        total += g;
        nearest = fmax(nearest, g);
    }
    const float2 residual = total > 0.0f ? guidance_share(nearest) * sum / total : (float2)(0.0f);
    /* the last pixels of a coarse level may lie beyond the chart */
    const float2 last = (float2)(grid.z ? q.x : grid.x - 0.5f, grid.y - 0.5f);
    start[y * size.x + x] = (bilinear_flow(flow, LEAST(q, last), grid) + residual) / scale;
    near[y * size.x + x] = nearest;
}

/* Add to the system of one linearisation (flow_system) a spring that holds the flow near its start. */
__kernel void guidance_pull(__global const float2 *start,  /* (grid.y, grid.x) */
                            __global const float *near,    /* (grid.y, grid.x) */
                            int4 grid, int pitch,          /* run size: grid.xy */
                            float strength,                /* in units of the data term */
                            int way,                       /* place of the system among `board`'s */
                            __global float *board)         /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    __global float *p = board + way * 2 * grid.y * BOARD_PLANES * pitch + board_index(x, y, grid, pitch);
    const int at = y * grid.x + x;
    const float k = strength * guidance_share(near[at]);
    p[BOARD_R1 * pitch] /= 1.0f + k * p[BOARD_R1 * pitch];
    p[BOARD_R2 * pitch] /= 1.0f + k * p[BOARD_R2 * pitch];
    p[BOARD_B1 * pitch] += k * start[at].x;
    p[BOARD_B2 * pitch] += k * start[at].y;
}

/* What a flow brings of the other image's feature. */
__kernel void guidance_bring(__global const float4 *feature, /* (grid.y, grid.x) of the other image */
                             __global const float2 *flow,    /* (grid.y, grid.x) px */
                             int4 grid,                      /* run size */
                             __global float4 *brought)       /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < grid.x && y < grid.y)
        brought[y * grid.x + x] = feature_sample(feature, x, y, flow[y * grid.x + x], grid);
}

/* How badly what a flow brings here fits; the slopes tell more than the brightness. */
static inline float guidance_cost(float4 a, float4 b) {
    const float4 t = fabs(a - b);
    return fmin(t.x + 2.0f * (t.y + t.z), 0.5f);
}

static inline float guidance_link(__global const float4 *feature, float4 here, int2 p, int4 grid, float contrast) {
    if (!grid_border(&p, grid))
        return 0.0f;
    const float4 there = feature[p.y * grid.x + p.x];
    return here.w * there.w > 0.0f ? exp(-fabs(here.x - there.x) / contrast) : 1.0f;
}

/* The vote between the old flow (-1) and the new one (1), as a system for flow_relax with one unknown: each
   pixel's evidence, seeds at the guides, the old flow far from them; neighbours of one colour go together. */
__kernel void guidance_vote(__global const float4 *feature, /* (grid.y, grid.x) */
                            __global const float4 *old,     /* (grid.y, grid.x) the other image by the old flow */
                            __global const float4 *new,     /* (grid.y, grid.x) the same by the new flow */
                            __global const float *near,     /* (grid.y, grid.x) */
                            int4 grid, int pitch,           /* run size: grid.xy */
                            float evidence,                 /* weight of a difference in cost */
                            float trust,                    /* weight of the seeds */
                            float contrast,                 /* step of h across which neighbours part */
                            __global float *board)          /* (2, grid.y, BOARD_PLANES, pitch), all 0 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 a = feature[at], b = old[at], c = new[at];
    const float gain = a.w * b.w * c.w > 0.0f ? evidence * (guidance_cost(a, b) - guidance_cost(a, c)) : 0.0f;
    const float n2 = near[at] * near[at], n8 = n2 * n2 * n2 * n2;
    const float seed = trust * n8 * n8; /* a quarter of the sigma */
    const float far = 1.0f - guidance_share(near[at]);
    const float4 links = (float4)(guidance_link(feature, a, (int2)(x + 1, y), grid, contrast),
                                  guidance_link(feature, a, (int2)(x - 1, y), grid, contrast),
                                  guidance_link(feature, a, (int2)(x, y + 1), grid, contrast),
                                  guidance_link(feature, a, (int2)(x, y - 1), grid, contrast));
    board_solve(board + board_index(x, y, grid, pitch), pitch,
                (float3)(fabs(gain) + seed + far, 0.0f, 0.0f), (float2)(gain + seed - far, 0.0f), links);
}

/* The new flow where the vote is for it. */
__kernel void guidance_choose(__global const float2 *vote, /* (grid.y, grid.x) -1 to 1 in x */
                              __global const float2 *new,  /* (grid.y, grid.x) */
                              int4 grid,                   /* run size */
                              __global float2 *flow)       /* (grid.y, grid.x) the old one; in place */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    if (vote[at].x > 0.0f)
        flow[at] = new[at];
}

/* The flow refined from where guides led it around these; elsewhere the flow found without them, to the bit. */
__kernel void guidance_blend(__global const float2 *refined, /* (grid.y, grid.x) */
                             __global const float *near,     /* (grid.y, grid.x) */
                             int4 grid,                      /* run size */
                             __global float2 *flow)          /* (grid.y, grid.x) in place */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float w = fmin(10.0f * guidance_share(near[at]), 1.0f); /* the new flow wins nowhere where w < 1 */
    if (w > 0.0f)
        flow[at] += w * (refined[at] - flow[at]);
}
