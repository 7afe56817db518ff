/* Where each layer is sampled: x_k(p) = p + sum over j of w_j(p) F_jk(p). A field holds, on the box of one layer
   of the working grid, (displacement, colour weight); the displacement is a difference of points, so that it
   is continuous over the poles. */

/* Coefficients below this move nothing by as much as a thousandth of a pixel. */
#define GEOMETRY_NEGLIGIBLE 1e-5f

/* Add one other layer's part. guess = 0: read F_jk at p (first order, as published). Otherwise F_kj is read at
   the place that `guess` says layer k is sampled, whose way to p it is: x_k = p - sum_j w_j F_kj(x_k). */
__kernel void geometry_add(__global const float *blend_j,   /* (box_j.w, box_j.z) */
                           int4 box_j,                      /* place on the working grid */
                           __global const float4 *layer_k,  /* (box_k.w, box_k.z) r, g, b, valid */
                           int4 box_k,                      /* place on the working grid */
                           int every,                       /* columns and rows from one to the next */
                           int4 border, float4 lens,        /* working grid */
                           __global const float2 *flow,     /* chart grid, px */
                           int4 grid, float16 chart,        /* chart */
                           int use_guess,
                           __global const float4 *guess,    /* (size.y, size.x) displacement */
                           __global float4 *field,          /* (size.y, size.x) displacement is added */
                           int2 size)                       /* box_k.zw / every, rounded up; run size */
{
    const int i = get_global_id(0), j = get_global_id(1);
    if (i >= size.x || j >= size.y)
        return;
    const int x = i * every, y = j * every, at = j * size.x + i;
    const int2 p = (int2)(x + box_k.x, y + box_k.y);
    const int at_j = box_index(p, box_j);
    if (at_j < 0)
        return;
    const float w = blend_j[at_j];
    if (w < GEOMETRY_NEGLIGIBLE || layer_k[y * box_k.z + x].w == 0.0f)
        return;
    float3 q = canvas_point((float2)(p.x + 0.5f, p.y + 0.5f), lens);
    if (use_guess) {
        q += guess[at].xyz;
        if (lens.y != 0.0f)
            q /= ROOT(square3(q));
    }
    const float2 u = chart_position(q, &chart);
    const float2 f = bilinear_flow(flow, u, grid);
    if (f.x == 0.0f && f.y == 0.0f)
        return;
    /* on a sphere q is the chart's point at u, on a plane that wraps a copy of it */
    const float3 d = chart.sd == 0.0f ? (float3)(f.x / chart.s9, f.y / chart.sa, 0.0f) : chart_point(u + f, &chart) - q;
    field[at].xyz += (use_guess ? -w : w) * d;
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

/* s_k (not yet normalised) = m_k * exp(a_k - max a). */
__kernel void geometry_softmax(__global float4 *field,       /* (box.w, box.z); s_k replaces a_k */
                               __global const float *blend,  /* (box.w, box.z) w_k */
                               __global const uchar *rim,    /* (box.w, box.z) m_k in 255ths */
                               int4 box, int4 border,        /* place on the working grid, run size */
                               __global const float *highest) /* (border.y, border.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    const float a = field[at].w - highest[(y + box.y) * border.x + x + box.x];
    field[at].w = blend[at] > 0.0f
                      ? rim[at] / 255.0f * exponential1(GREATEST(a, -87.0f))
                      : 0.0f;
}

/* The longest displacement of each row: how many rows a band needs beyond its own. */
__kernel void geometry_reach(__global const float4 *field, /* (box.w, box.z) */
                             int4 box,                     /* run size: (box.w, 1) */
                             int plane,                    /* 1: only the y component counts */
                             __global float *reach)        /* (box.w) in units of the field */
{
    const int y = get_global_id(0);
    if (y >= box.w || get_global_id(1) > 0)
        return;
    float longest = 0.0f;
    for (int x = 0; x < box.z; ++x) {
        const float3 d = field[y * box.z + x].xyz;
        const float length = plane ? MAGNITUDE(d.y) : ROOT(square3(d));
        longest = GREATEST(longest, length);
    }
    reach[y] = longest;
}
