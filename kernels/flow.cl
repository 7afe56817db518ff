/* Dense flow of one pair: combined local-global optical flow. The data term is Lucas and Kanade's windowed
   least squares on brightness and gradient, the smoothness term spreads it over untextured pixels and beyond
   the mask; coarse to fine, with warping (Bruhn, Weickert, Schnoerr 2005; normalised as Zimmer et al. 2011).

   A feature is (h, dh/dx, dh/dy, valid): h is log brightness less its local mean, blind to gain. Flow is in
   pixels of the level's grid; grid = (width, height, wraps, 0). */

/* Bilinear reading of the local mean, which is kept on the next coarser level. */
static inline float flow_local_mean(__global const float *mean, __global const float *weight, int4 coarse, int x,
                                    int y) {
    int4 at;
    const float4 w = bilinear_taps((float2)(x + 0.5f, y + 0.5f) * 0.5f, coarse, &at);
    const float4 known = (float4)(weight[at.x], weight[at.y], weight[at.z], weight[at.w]);
    const float4 values = (float4)(mean[at.x], mean[at.y], mean[at.z], mean[at.w]);
    const float4 shares = known > 1e-6f ? w : (float4)(0.0f), parts = shares * values;
    const float total = shares.x + shares.y + shares.z + shares.w;
    return total > 0.0f ? (parts.x + parts.y + parts.z + parts.w) / total : 0.0f;
}

/* Slope of the image between two neighbours of a pixel, or beside it where one is not valid; 0: neither is. */
static inline float flow_slope(__global const float *image, __global const float *mask, int at, int2 before,
                               int2 after, int4 grid) {
    const int first = grid_index(before, grid), last = grid_index(after, grid);
    const int from = first >= 0 && mask[first] != 0.0f ? first : at, to = last >= 0 && mask[last] != 0.0f ? last : at;
    return (image[to] - image[from]) * (from != at && to != at ? 0.5f : 1.0f);
}

__kernel void flow_feature(__global const float *image,  /* (grid.y, grid.x) log brightness */
                           __global const float *mask,   /* (grid.y, grid.x), 0 or 1 */
                           int4 grid,                    /* run size */
                           __global const float *mean,   /* (coarse.y, coarse.x) local mean */
                           __global const float *weight, /* (coarse.y, coarse.x) of the mean */
                           int4 coarse,                  /* the next coarser level */
                           __global float4 *feature)    /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    if (mask[at] == 0.0f) {
        feature[at] = (float4)(0.0f);
        return;
    }
    const float dx = flow_slope(image, mask, at, (int2)(x - 1, y), (int2)(x + 1, y), grid);
    const float dy = flow_slope(image, mask, at, (int2)(x, y - 1), (int2)(x, y + 1), grid);
    feature[at] = (float4)(image[at] - flow_local_mean(mean, weight, coarse, x, y), dx, dy, 1.0f);
}

/* Sample feature at q + flow(q), bilinear; w is the share of valid taps. */
__kernel void flow_warp(__global const float4 *feature, /* (grid.y, grid.x) of the other image */
                        __global const float2 *flow,    /* (grid.y, grid.x) px */
                        int4 grid,                      /* run size */
                        __global float4 *warped)        /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const float2 f = flow[y * grid.x + x];
    const int2 whole = floor_int2(f);
    int4 at;
    const float4 w = grid_taps((int2)(x, y) + whole, f - convert_float2(whole), grid, &at);
    const float4 sum = w.x * feature[at.x] + w.y * feature[at.y] + w.z * feature[at.z] + w.w * feature[at.w];
    warped[y * grid.x + x] = sum.w > 0.999f ? sum / sum.w : (float4)(0.0f);
}

static inline float4 flow_mean_feature(__global const float4 *a, __global const float4 *b, int2 p, int4 grid) {
    if (!grid_border(&p, grid))
        return (float4)(0.0f);
    const float4 fa = a[p.y * grid.x + p.x], fb = b[p.y * grid.x + p.x];
    return fa.w * fb.w > 0.0f ? 0.5f * (fa + fb) : (float4)(0.0f);
}

/* The linearised constraints of one warp, J (du, dv) = -(J13, J23), weighted robustly. */
__kernel void flow_tensor(__global const float4 *feature, /* (grid.y, grid.x) */
                          __global const float4 *warped,  /* (grid.y, grid.x) the other, warped */
                          int4 grid,                      /* run size */
                          float brightness,               /* weight of brightness constancy */
                          float gradient,                 /* weight of gradient constancy */
                          float noise,                    /* amplitude of h below which texture is noise */
                          __global float4 *tensor,        /* (grid.y, grid.x) J11, J12, J22, valid */
                          __global float2 *right)         /* (grid.y, grid.x) J13, J23 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 a = feature[at], b = warped[at];
    float4 j = (float4)(0.0f);
    float2 r = (float2)(0.0f);
    if (a.w * b.w > 0.0f) {
        const float robust = 1e-3f, zeta = noise * noise;
        const float2 d = 0.5f * (a.yz + b.yz);
        const float4 t = b - a;
        const float n = 1.0f / (square2(d) + zeta);
        const float w = brightness * n / ROOT(t.x * t.x * n + robust * robust);
        j = (float4)(w * d.x * d.x, w * d.x * d.y, w * d.y * d.y, 1.0f);
        r = w * t.x * d;
        const float4 west = flow_mean_feature(feature, warped, (int2)(x - 1, y), grid);
        const float4 east = flow_mean_feature(feature, warped, (int2)(x + 1, y), grid);
        const float4 north = flow_mean_feature(feature, warped, (int2)(x, y - 1), grid);
        const float4 south = flow_mean_feature(feature, warped, (int2)(x, y + 1), grid);
        if (west.w * east.w * north.w * south.w > 0.0f) {
            const float2 dx = 0.5f * (east.yz - west.yz);   /* d(hx)/dx, d(hy)/dx */
            const float2 dy = 0.5f * (south.yz - north.yz); /* d(hx)/dy, d(hy)/dy */
            const float nx = 1.0f / (dx.x * dx.x + dy.x * dy.x + zeta);
            const float ny = 1.0f / (dx.y * dx.y + dy.y * dy.y + zeta);
            const float g = gradient / ROOT(t.y * t.y * nx + t.z * t.z * ny + robust * robust);
            j.x += g * (nx * dx.x * dx.x + ny * dx.y * dx.y);
            j.y += g * (nx * dx.x * dy.x + ny * dx.y * dy.y);
            j.z += g * (nx * dy.x * dy.x + ny * dy.y * dy.y);
            r.x += g * (nx * dx.x * t.y + ny * dx.y * t.z);
            r.y += g * (nx * dy.x * t.y + ny * dy.y * t.z);
        }
    }
    tensor[at] = j;
    right[at] = r;
}

/* Add to the sums j, r what a pixel p of the window has, if it lies on the grid; inner: it does. */
static inline void flow_add(__global const float4 *tensor, __global const float2 *right, int2 p, float weight,
                            int4 grid, bool inner, float4 *j, float2 *r) {
    const int at = inner ? p.y * grid.x + p.x : grid_index(p, grid);
    if (at < 0)
        return;
    *j += weight * tensor[at];
    *r += weight * right[at];
}

/* Sum the constraints over the Lucas-Kanade window (binomial, 3 x 3). */
__kernel void flow_window(__global const float4 *tensor, /* (grid.y, grid.x) */
                          __global const float2 *right,  /* (grid.y, grid.x) */
                          int4 grid,                     /* run size */
                          __global float4 *tensor_out,   /* (grid.y, grid.x) */
                          __global float2 *right_out)    /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const bool inner = x > 0 && x + 1 < grid.x && y > 0 && y + 1 < grid.y;
    float4 j = (float4)(0.0f);
    float2 r = (float2)(0.0f);
    for (int row = y - 1; row <= y + 1; ++row) {
        const float weight = row == y ? 0.5f : 0.25f;
        flow_add(tensor, right, (int2)(x - 1, row), 0.25f * weight, grid, inner, &j, &r);
        flow_add(tensor, right, (int2)(x, row), 0.5f * weight, grid, inner, &j, &r);
        flow_add(tensor, right, (int2)(x + 1, row), 0.25f * weight, grid, inner, &j, &r);
    }
    tensor_out[y * grid.x + x] = j;
    right_out[y * grid.x + x] = r;
}

/* How far two pixels are apart: step of the image over `contrast`, squared difference of their flows. */
static inline float2 flow_gap(__global const float2 *flow, __global const float4 *feature, int at, int to,
                              float contrast) {
    const float4 a = feature[at], b = feature[to];
    const float step = (a.x - b.x) / contrast;
    /* an edge of the image is where the flow may jump */
    return (float2)(a.w * b.w > 0.0f ? LEAST(MAGNITUDE(step), 80.0f) : 0.0f, square2(flow[to] - flow[at]));
}

/* The linear system of one warp: diag/off-diagonals of the data term, right-hand side for the whole flow (not
   the increment), and the smoothness weights towards the east and south neighbours. */
__kernel void flow_system(__global const float4 *tensor,  /* (grid.y, grid.x) */
                          __global const float2 *right,   /* (grid.y, grid.x) */
                          __global const float2 *flow,    /* (grid.y, grid.x) of this linearisation */
                          __global const float4 *feature, /* (grid.y, grid.x) */
                          int4 grid,                      /* run size */
                          float smoothness, float contrast,
                          __global float4 *left_side, /* (grid.y, grid.x) J11, J12, J22, weight to the east */
                          __global float4 *right_side) /* (grid.y, grid.x) b1, b2, weight to the south, 0 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float4 j = tensor[at];
    const float2 f = flow[at], r = right[at];
    const int east = grid_index((int2)(x + 1, y), grid), south = grid_index((int2)(x, y + 1), grid);
    const float2 to_east = flow_gap(flow, feature, at, east < 0 ? at : east, contrast);
    const float2 to_south = flow_gap(flow, feature, at, south < 0 ? at : south, contrast);
    const float4 alike = smoothness * exponential((float4)(-to_east.x, -to_south.x, 0.0f, 0.0f));
    left_side[at] = (float4)(j.xyz, east < 0 ? 0.0f : alike.x / ROOT(to_east.y + 1e-4f));
    right_side[at] = (float4)(j.x * f.x + j.y * f.y - r.x, j.y * f.x + j.z * f.y - r.y,
                              south < 0 ? 0.0f : alike.y / ROOT(to_south.y + 1e-4f), 0.0f);
}

/* One half-sweep of red-black successive over-relaxation, in place. */
__kernel void flow_relax(__global const float4 *left_side,  /* (grid.y, grid.x) */
                         __global const float4 *right_side, /* (grid.y, grid.x) */
                         int4 grid, int colour,             /* run size: ((grid.x + 1) / 2, grid.y) */
                         float relaxation,
                         __global float2 *flow) /* (grid.y, grid.x) */
{
    const int y = get_global_id(1), x = 2 * get_global_id(0) + ((y + colour) & 1);
    if (x >= grid.x || y >= grid.y)
        return;
    /* across a border that does not wrap the weights are 0, so that any place will do */
    const int row = y * grid.x, at = row + x;
    const int east = row + (x + 1 < grid.x ? x + 1 : 0), west = row + (x > 0 ? x : grid.x) - 1;
    const int south = (y + 1 < grid.y ? row + grid.x : 0) + x, north = (y > 0 ? row : grid.y * grid.x) - grid.x + x;
    const float4 j = left_side[at], b = right_side[at];
    const float from_west = left_side[west].w, from_north = right_side[north].z;
    const float2 sum = b.xy + j.w * flow[east] + b.z * flow[south] + from_west * flow[west] + from_north * flow[north];
    const float2 diagonal = j.xz + (j.w + b.z + from_west + from_north);
    const float2 step = diagonal > 0.0f ? relaxation / diagonal : (float2)(0.0f);
    float2 f = flow[at];
    f.x += step.x * (sum.x - j.y * f.y - diagonal.x * f.x);
    f.y += step.y * (sum.y - j.y * f.x - diagonal.y * f.y);
    flow[at] = f;
}

/* The median takes this many pixels of a row at a time: compilers for CPUs do not find such work on their own. */
#define FLOW_CHUNK 4

static inline void flow_sort(float8 *a, float8 *b) {
    const float8 low = LEAST(*a, *b);
    *b = GREATEST(*a, *b);
    *a = low;
}

/* The chunk of the flow from (x, y) on, moved by (dx, dy); beyond the border a pixel stands for its neighbour. */
static inline float8 flow_chunk(__global const float2 *flow, int x, int y, int dx, int dy, int4 grid, bool inner) {
    if (inner) {
        __global const float2 *p = flow + (y + dy) * grid.x + x + dx;
        return (float8)(p[0], p[1], p[2], p[3]);
    }
    float2 values[FLOW_CHUNK];
    for (int i = 0; i < FLOW_CHUNK; ++i) {
        const int column = LEAST(x + i, grid.x - 1), at = grid_index((int2)(column + dx, y + dy), grid);
        values[i] = flow[at < 0 ? y * grid.x + column : at];
    }
    return (float8)(values[0], values[1], values[2], values[3]);
}

/* 3 x 3 median of each component: removes outliers, keeps edges of motion. */
__kernel void flow_median(__global const float2 *flow, /* (grid.y, grid.x) */
                          int4 grid,                   /* run size: grid.x / FLOW_CHUNK, rounded up, grid.y */
                          __global float2 *median)     /* (grid.y, grid.x) */
{
    const int y = get_global_id(1), x = get_global_id(0) * FLOW_CHUNK;
    if (x >= grid.x || y >= grid.y)
        return;
    const bool inner = x > 0 && x + FLOW_CHUNK < grid.x && y > 0 && y + 1 < grid.y;
    /* written out: indices that a loop counts would keep the array in memory */
    float8 v[9] = {
        flow_chunk(flow, x, y, -1, -1, grid, inner), flow_chunk(flow, x, y, 0, -1, grid, inner),
        flow_chunk(flow, x, y, 1, -1, grid, inner),  flow_chunk(flow, x, y, -1, 0, grid, inner),
        flow_chunk(flow, x, y, 0, 0, grid, inner),   flow_chunk(flow, x, y, 1, 0, grid, inner),
        flow_chunk(flow, x, y, -1, 1, grid, inner),  flow_chunk(flow, x, y, 0, 1, grid, inner),
        flow_chunk(flow, x, y, 1, 1, grid, inner)};
    /* the median of nine by 19 exchanges */
    flow_sort(v + 1, v + 2); flow_sort(v + 4, v + 5); flow_sort(v + 7, v + 8);
    flow_sort(v + 0, v + 1); flow_sort(v + 3, v + 4); flow_sort(v + 6, v + 7);
    flow_sort(v + 1, v + 2); flow_sort(v + 4, v + 5); flow_sort(v + 7, v + 8);
    flow_sort(v + 0, v + 3); flow_sort(v + 5, v + 8); flow_sort(v + 4, v + 7);
    flow_sort(v + 3, v + 6); flow_sort(v + 1, v + 4); flow_sort(v + 2, v + 5);
    flow_sort(v + 4, v + 7); flow_sort(v + 4, v + 2); flow_sort(v + 6, v + 4);
    flow_sort(v + 4, v + 2);
    const float2 values[FLOW_CHUNK] = {v[4].s01, v[4].s23, v[4].s45, v[4].s67};
    for (int i = 0; i < FLOW_CHUNK && x + i < grid.x; ++i)
        median[y * grid.x + x + i] = values[i];
}

/* Carry the flow of the coarser level to the next finer one: bilinear, doubled. */
__kernel void flow_expand(__global const float2 *coarse, /* (grid.y, grid.x) px of the coarse level */
                          int4 grid,                     /* of the coarse level */
                          __global float2 *fine,         /* (size.y, size.x) px of the fine level */
                          int2 size)                     /* run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float2 q = 0.5f * (float2)(x + 0.5f, y + 0.5f);
    fine[y * size.x + x] = 2.0f * bilinear_flow(coarse, q, grid);
}
