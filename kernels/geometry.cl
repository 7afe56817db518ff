/* Where each layer is sampled: x_k(p) = p + sum over j of w_j(p) F_jk(p). A field holds, on the box of one layer of the
   working grid, (displacement, colour weight); the displacement is a difference of points, so that it is continuous
   over the poles. */

/* Coefficients below this move nothing by as much as a thousandth of a pixel. */
#define GEOMETRY_NEGLIGIBLE 1e-5f

/* Pixels of a row that a work item takes: compilers for CPUs make vectors only of what is written as vectors. */
#define GEOMETRY_CHUNK 4

/* The coefficient of layer j where layer k has its pixel (x, y); 0 where it moves nothing, or a layer is not. */
static inline float geometry_share(__global const float *blend_j, int4 box_j, __global const float4 *layer_k,
                                   int4 box_k, int x, int y) {
    const int at_j = box_index((int2)(x + box_k.x, y + box_k.y), box_j);
    const float w = at_j < 0 ? 0.0f : blend_j[at_j];
    return w < GEOMETRY_NEGLIGIBLE || layer_k[y * box_k.z + x].w == 0.0f ? 0.0f : w;
}

/* Where flow leads from four points q, by its chart, as differences of points; moves: where it leads anywhere. */
static inline points4 geometry_steps(points4 q, __global const float2 *flow, int4 grid, const float16 *chart,
                                     int4 *moves) {
    const bool plane = chart->sd == 0.0f;
    float4 u, v;
    if (plane) {
        const float2 a = chart_position((float3)(q.x.x, q.y.x, 0.0f), chart);
        const float2 b = chart_position((float3)(q.x.y, q.y.y, 0.0f), chart);
        const float2 c = chart_position((float3)(q.x.z, q.y.z, 0.0f), chart);
        const float2 d = chart_position((float3)(q.x.w, q.y.w, 0.0f), chart);
        u = (float4)(a.x, b.x, c.x, d.x);
        v = (float4)(a.y, b.y, c.y, d.y);
    } else {
        u = chart_sphere_position4(q, chart, &v);
    }
    const float2 a = bilinear_flow(flow, (float2)(u.x, v.x), grid), b = bilinear_flow(flow, (float2)(u.y, v.y), grid);
    const float2 c = bilinear_flow(flow, (float2)(u.z, v.z), grid), d = bilinear_flow(flow, (float2)(u.w, v.w), grid);
    const float4 fx = (float4)(a.x, b.x, c.x, d.x), fy = (float4)(a.y, b.y, c.y, d.y);
    *moves = fx != 0.0f || fy != 0.0f;
    if (plane) /* on one that wraps, u may be of a copy of q */
        return (points4){fx / chart->s9, fy / chart->sa, (float4)(0.0f)};
    const points4 to = chart_sphere4(u + fx, v + fy, chart);
    return (points4){to.x - q.x, to.y - q.y, to.z - q.z};
}

/* Add one other layer's part. */
__kernel void geometry_add(__global const float *blend_j,   /* (box_j.w, box_j.z) */
                           int4 box_j,                      /* place on the working grid */
                           __global const float4 *layer_k,  /* (box_k.w, box_k.z) r, g, b, valid */
                           int4 box_k,                      /* place on the working grid; run size, its columns
                                                               by GEOMETRY_CHUNK, rounded up */
                           float4 lonlat,                   /* working grid */
                           __global const float2 *flow,     /* chart grid, px: F_jk */
                           int4 grid, float16 chart,        /* chart */
                           int first,                       /* 1: nothing is in the field yet */
                           __global float4 *field)          /* (box_k.w, box_k.z) displacement is added, or set */
{
    const int x = get_global_id(0) * GEOMETRY_CHUNK, y = get_global_id(1);
    if (x >= box_k.z || y >= box_k.w)
        return;
    const int at = y * box_k.z + x, last = box_k.z - 1 - x;
    float share[GEOMETRY_CHUNK], most = 0.0f;
    for (int k = 0; k < GEOMETRY_CHUNK; ++k) {
        if (first && k <= last)
            field[at + k] = (float4)(0.0f);
        share[k] = k <= last ? geometry_share(blend_j, box_j, layer_k, box_k, x + k, y) : 0.0f;
        most = GREATEST(most, share[k]);
    }
    if (most == 0.0f)
        return;
    const float4 px = convert_float4(x + (int4)(0, 1, 2, 3) + box_k.x) + 0.5f;
    const float4 py = (float4)(y + box_k.y + 0.5f);
    const points4 q = lonlat.y == 0.0f ? (points4){px, py, (float4)(0.0f)} : canvas_sphere4(px, py, lonlat);
    int4 moves;
    const points4 d = geometry_steps(q, flow, grid, &chart, &moves);
    const float3 way[GEOMETRY_CHUNK] = {(float3)(d.x.x, d.y.x, d.z.x), (float3)(d.x.y, d.y.y, d.z.y),
                                        (float3)(d.x.z, d.y.z, d.z.z), (float3)(d.x.w, d.y.w, d.z.w)};
    const int moved[GEOMETRY_CHUNK] = {moves.x, moves.y, moves.z, moves.w};
    for (int k = 0; k < GEOMETRY_CHUNK; ++k)
        if (share[k] > 0.0f && moved[k])
            field[at + k].xyz += share[k] * way[k];
}

/* A weight falls to e to the power of minus that at most: where a cut takes one layer, the others weigh less still. */
#define GEOMETRY_FAINTEST 14.0f

/* Limit how far a layer is displaced towards a border of the canvas to half of the way to its last pixels' centres, and
   have it weigh the less the more it is shortened for that. What it would show from beyond is cut off, and another
   layer, which shows it, would take over there along a hard edge; now it does where both still lie on each other. */
__kernel void geometry_within(__global float4 *field, /* (box.w, box.z), in place */
                              int4 box, int4 border,  /* place on the working grid, run size; working grid */
                              float4 lonlat,
                              float fade)             /* of a weight's logarithm, for each working px */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w)
        return;
    const float4 own = field[at];
    if (square3(own.xyz) == 0.0f)
        return;
    const float2 q = (float2)(x + box.x + 0.5f, y + box.y + 0.5f);
    const float2 there = layer_near(q, own.xyz, lonlat);
    const float2 size = (float2)(border.x, border.y), least = 0.5f * q + 0.25f, most = 0.5f * (q + size) - 0.25f;
    float2 inside = there;
    if (!border.z)
        inside.x = LIMITED(there.x, least.x, most.x);
    if (!(border.w & 1))
        inside.y = GREATEST(there.y, least.y);
    if (!(border.w & 2))
        inside.y = LEAST(inside.y, most.y);
    const float shortened = ROOT(square2(inside - there));
    if (shortened > 0.0f)
        field[at] = (float4)(canvas_point(inside, lonlat) - canvas_point(q, lonlat),
                             own.w * exponential(-LEAST(fade * shortened, GEOMETRY_FAINTEST)));
}

/* a_k = sharpness * w_k * (1 + magnitude * f_k / width), with f_k = |displacement| / (1 - w_k); and the maximum
   over the layers, without which exp overflows. */
__kernel void geometry_activation(__global float4 *field,        /* (box.w, box.z); a_k goes to w */
                                  __global const float *blend,   /* (box.w, box.z) w_k */
                                  int4 box, int4 border,         /* place on the working grid, run size */
                                  float sharpness, float magnitude, float width,
                                  float furthest,          /* plausible length of flow, in width's unit */
                                  __global float *highest) /* (border.y, border.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    const float w = blend[at];
    if (w == 0.0f)
        return;
    const float d = ROOT(square3(field[at].xyz)), f = w < 1.0f ? d / (1.0f - w) : 0.0f;
    const float a = sharpness * w * (1.0f + magnitude * LEAST(f, furthest) / width);
    field[at].w = a;
    const int top = (y + box.y) * border.x + x + box.x;
    highest[top] = GREATEST(highest[top], a);
}

/* s_k (not yet normalised) = exp(a_k - max a). */
__kernel void geometry_softmax(__global float4 *field,       /* (box.w, box.z); s_k replaces a_k */
                               __global const float *blend,  /* (box.w, box.z) w_k */
                               int4 box, int4 border,        /* place on the working grid, run size */
                               __global const float *highest) /* (border.y, border.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    const float a = field[at].w - highest[(y + box.y) * border.x + x + box.x];
    field[at].w = blend[at] > 0.0f ? exponential(GREATEST(a, -87.0f)) : 0.0f;
}

/* The longest displacement of each row, and how many rows it leads up or down at most: how many rows a band needs
   beyond its own. */
__kernel void geometry_reach(__global const float4 *field, /* (box.w, box.z) */
                             int4 box,                     /* place on the working grid; run size: (box.w, 1) */
                             float4 lonlat,                /* working grid */
                             __global float2 *reach)       /* (box.w) in units of the field; working px */
{
    const int y = get_global_id(0);
    if (y >= box.w || get_global_id(1) > 0)
        return;
    const float4 py = (float4)(y + box.y + 0.5f);
    float longest = 0.0f, furthest = 0.0f;
    for (int x = 0; x < box.z; x += GEOMETRY_CHUNK) {
        float3 d[GEOMETRY_CHUNK];
        for (int k = 0; k < GEOMETRY_CHUNK; ++k)
            d[k] = x + k < box.z ? field[y * box.z + x + k].xyz : (float3)(0.0f);
        const points4 way = {(float4)(d[0].x, d[1].x, d[2].x, d[3].x), (float4)(d[0].y, d[1].y, d[2].y, d[3].y),
                             (float4)(d[0].z, d[1].z, d[2].z, d[3].z)};
        const float4 length = way.x * way.x + way.y * way.y + way.z * way.z;
        const float most = GREATEST(GREATEST(length.x, length.y), GREATEST(length.z, length.w));
        if (most == 0.0f)
            continue; /* as most of a layer */
        float4 to = py + way.y;
        if (lonlat.y != 0.0f) {
            const points4 q = canvas_sphere4(convert_float4(x + box.x + (int4)(0, 1, 2, 3)) + 0.5f, py, lonlat);
            canvas_sphere_position4((points4){q.x + way.x, q.y + way.y, q.z + way.z}, lonlat, &to);
        }
        const float4 rows = length > 0.0f ? MAGNITUDE(to - py) : (float4)(0.0f);
        longest = GREATEST(longest, most);
        furthest = GREATEST(furthest, GREATEST(GREATEST(rows.x, rows.y), GREATEST(rows.z, rows.w)));
    }
    reach[y] = (float2)(ROOT(longest), furthest);
}
