/* Dense flow of one pair: combined local-global optical flow. The data term is Lucas and Kanade's windowed
   least squares on brightness and gradient, the smoothness term spreads it over untextured pixels and beyond
   the mask; coarse to fine, with warping (Bruhn, Weickert, Schnoerr 2005; normalised as Zimmer et al. 2011).

   A feature is (h, dh/dx, dh/dy, valid): h is log brightness less its local mean, blind to gain. Flow is in
   pixels of the level's grid; grid = (width, height, wraps, 0). The two ways of a pair, from a to b and from b to a,
   are calculated at a time where they are small, on boards (common.cl). */

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
                           int way,                      /* place among `features` */
                           __global float4 *features)    /* (ways, grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    __global float4 *feature = features + way * grid.y * grid.x;
    if (mask[at] == 0.0f) {
        feature[at] = (float4)(0.0f);
        return;
    }
    const float dx = flow_slope(image, mask, at, (int2)(x - 1, y), (int2)(x + 1, y), grid);
    const float dy = flow_slope(image, mask, at, (int2)(x, y - 1), (int2)(x, y + 1), grid);
    feature[at] = (float4)(image[at] - flow_local_mean(mean, weight, coarse, x, y), dx, dy, 1.0f);
}

/* Begin a level: the features of one or both ways on boards. */
__kernel void flow_board(__global const float4 *features, /* (2, grid.y, grid.x) */
                         int4 grid, int pitch,            /* run size: 2 pitch, grid.y, ways */
                         int first,                       /* the first of these ways */
                         __global float *board)           /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= 2 * pitch || y >= grid.y)
        return;
    __global float *p = board + get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch + board_index(x, y, grid, pitch);
    float4 f = (float4)(0.0f);
    if (x < grid.x)
        f = features[((first + get_global_id(2)) * grid.y + y) * grid.x + x];
    p[BOARD_H * pitch] = f.x;
    p[BOARD_HX * pitch] = f.y;
    p[BOARD_HY * pitch] = f.z;
    p[BOARD_VALID * pitch] = f.w;
}

/* Begin a linearisation: the flow, and what it brings of the other image's feature. */
__kernel void flow_warp(__global const float4 *features, /* (2, grid.y, grid.x) */
                        __global const float2 *flows,    /* (2, grid.y, grid.x) px */
                        int4 grid, int pitch,            /* run size: 2 pitch, grid.y, ways */
                        int first,                       /* the first of these ways */
                        __global float *board)           /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
{
    const int x = get_global_id(0), y = get_global_id(1), way = first + get_global_id(2);
    if (x >= 2 * pitch || y >= grid.y)
        return;
    __global float *p = board + get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch + board_index(x, y, grid, pitch);
    float2 flow = (float2)(0.0f);
    float4 f = (float4)(0.0f);
    if (x < grid.x) {
        flow = flows[(way * grid.y + y) * grid.x + x];
        f = feature_sample(features + (1 - way) * grid.y * grid.x, x, y, flow, grid);
    }
    p[BOARD_U * pitch] = flow.x;
    p[BOARD_V * pitch] = flow.y;
    p[BOARD_WARPED_H * pitch] = f.x;
    p[BOARD_WARPED_HX * pitch] = f.y;
    p[BOARD_WARPED_HY * pitch] = f.z;
    p[BOARD_WARPED * pitch] = f.w;
}

/* What a flow leaves unexplained: per pixel that both images show, by how much the gradients of h differ where it
   leads, `most` at most and where it leads outside; -1 elsewhere. */
__kernel void flow_misfit(__global const float4 *features, /* (2, grid.y, grid.x) */
                          __global const float2 *flows,    /* (2, grid.y, grid.x) px */
                          int4 grid,                       /* run size: grid.x, grid.y, 2 */
                          float most,
                          __global float *misfit)          /* (2, grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1), way = get_global_id(2);
    if (x >= grid.x || y >= grid.y)
        return;
    const int pixel = y * grid.x + x, at = way * grid.y * grid.x + pixel;
    __global const float4 *other = features + (1 - way) * grid.y * grid.x;
    const float4 own = features[at];
    if (own.w == 0.0f || other[pixel].w == 0.0f) {
        misfit[at] = -1.0f;
        return;
    }
    const float4 there = feature_sample(other, x, y, flows[at], grid);
    const float off = ROOT(square2(own.yz - there.yz));
    misfit[at] = there.w > 0.0f ? LEAST(off, most) : most;
}

/* Most charts do not wrap, and compilers for CPUs take many pixels at a time only if they know. */
#ifndef WRAPS
#define WRAPS grid.z
#endif

/* Places on a board: of pixel k of a row and colour, its neighbours (a row beyond the border: any place), and the
   first of its colour's rows above and below, which hold its diagonal neighbours. */
typedef struct {
    int x, at, west, east, north, south;
    int above_west, above_east, below_west, below_east;
} flow_places;

static inline flow_places flow_around(int k, int y, int colour, int4 grid, int pitch) {
    flow_places p;
    const int odd = (y + colour) & 1, own = (colour * grid.y + y) * BOARD_PLANES * pitch + k;
    const int other = ((1 - colour) * grid.y + y) * BOARD_PLANES * pitch + k;
    const int row = BOARD_PLANES * pitch, up = y > 0 ? -row : 0, down = y + 1 < grid.y ? row : 0;
    p.x = 2 * k + odd;
    p.at = own;
    p.east = other + odd;
    p.west = p.east - 1;
    p.north = other + up;
    p.south = other + down;
    p.above_east = own + up + odd;
    p.above_west = p.above_east - 1;
    p.below_east = own + down + odd;
    p.below_west = p.below_east - 1;
    if (WRAPS) {
        const int above = y > 0 ? y - 1 : y, below = y + 1 < grid.y ? y + 1 : y;
        const bool start = p.x == 0, end = p.x == grid.x - 1;
        p.west = start ? board_index(grid.x - 1, y, grid, pitch) : p.west;
        p.east = end ? board_index(0, y, grid, pitch) : p.east;
        p.above_west = start ? board_index(grid.x - 1, above, grid, pitch) : p.above_west;
        p.above_east = end ? board_index(0, above, grid, pitch) : p.above_east;
        p.below_west = start ? board_index(grid.x - 1, below, grid, pitch) : p.below_west;
        p.below_east = end ? board_index(0, below, grid, pitch) : p.below_east;
    }
    return p;
}

/* The linearised constraints of one warp, J (du, dv) = -(J13, J23), weighted robustly. */
__kernel void flow_tensor(int4 grid, int pitch, /* run size: pitch, 2 grid.y, ways */
                          float brightness,     /* weight of brightness constancy */
                          float gradient,       /* weight of gradient constancy */
                          float noise,          /* amplitude of h below which texture is noise */
                          __global float *board) /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
{
    const int row = get_global_id(1), colour = row >= grid.y, y = row - colour * grid.y;
    if (row >= 2 * grid.y)
        return;
    board += get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch;
    const flow_places p = flow_around(get_global_id(0), y, colour, grid, pitch);
    __global const float *h = board + BOARD_H * pitch, *hx = board + BOARD_HX * pitch;
    __global const float *hy = board + BOARD_HY * pitch, *valid = board + BOARD_VALID * pitch;
    __global const float *warped_h = board + BOARD_WARPED_H * pitch, *warped_hx = board + BOARD_WARPED_HX * pitch;
    __global const float *warped_hy = board + BOARD_WARPED_HY * pitch, *warped = board + BOARD_WARPED * pitch;

    const float robust = 1e-3f, zeta = noise * noise;
    const float mx = 0.5f * (hx[p.at] + warped_hx[p.at]), my = 0.5f * (hy[p.at] + warped_hy[p.at]);
    const float t = warped_h[p.at] - h[p.at], tx = warped_hx[p.at] - hx[p.at], ty = warped_hy[p.at] - hy[p.at];
    const float n = 1.0f / (mx * mx + my * my + zeta);
    const float both = valid[p.at] * warped[p.at] > 0.0f ? 1.0f : 0.0f;
    const float w = both * brightness * n / ROOT(t * t * n + robust * robust);

    const float seen = both * valid[p.west] * warped[p.west] * valid[p.east] * warped[p.east] * valid[p.north] *
                       warped[p.north] * valid[p.south] * warped[p.south];
    const float whole = seen > 0.0f && y > 0 && y + 1 < grid.y ? 1.0f : 0.0f;
    /* derivatives in x and y of the mean slopes */
    const float xx = 0.25f * (hx[p.east] + warped_hx[p.east] - hx[p.west] - warped_hx[p.west]);
    const float yx = 0.25f * (hy[p.east] + warped_hy[p.east] - hy[p.west] - warped_hy[p.west]);
    const float xy = 0.25f * (hx[p.south] + warped_hx[p.south] - hx[p.north] - warped_hx[p.north]);
    const float yy = 0.25f * (hy[p.south] + warped_hy[p.south] - hy[p.north] - warped_hy[p.north]);
    const float nx = 1.0f / (xx * xx + xy * xy + zeta), ny = 1.0f / (yx * yx + yy * yy + zeta);
    const float g = whole * gradient / ROOT(tx * tx * nx + ty * ty * ny + robust * robust);
    const float gx = g * nx, gy = g * ny;

    board[BOARD_J11 * pitch + p.at] = w * mx * mx + gx * xx * xx + gy * yx * yx;
    board[BOARD_J12 * pitch + p.at] = w * mx * my + gx * xx * xy + gy * yx * yy;
    board[BOARD_J22 * pitch + p.at] = w * my * my + gx * xy * xy + gy * yy * yy;
    board[BOARD_J13 * pitch + p.at] = w * t * mx + gx * xx * tx + gy * yx * ty;
    board[BOARD_J23 * pitch + p.at] = w * t * my + gx * xy * tx + gy * yy * ty;
}

/* Sum over the Lucas-Kanade window (binomial, 3 x 3). share: a sixteenth, or 0 for a row that is not. */
static inline float flow_window(__global const float *j, flow_places p, float share, float above, float below) {
    return share * (4.0f * j[p.at] + 2.0f * (j[p.west] + j[p.east])) +
           above * (2.0f * j[p.north] + j[p.above_west] + j[p.above_east]) +
           below * (2.0f * j[p.south] + j[p.below_west] + j[p.below_east]);
}

/* Weight of smoothness towards neighbour `to`: less across an edge of the image, where the flow may jump, and by
   the total variation of the flow. */
static inline float flow_link(__global const float *board, int pitch, int at, int to, float contrast) {
    __global const float *h = board + BOARD_H * pitch, *valid = board + BOARD_VALID * pitch;
    __global const float *u = board + BOARD_U * pitch, *v = board + BOARD_V * pitch;
    const float step = (h[at] - h[to]) / contrast, du = u[to] - u[at], dv = v[to] - v[at];
    const float edge = valid[at] * valid[to] > 0.0f ? LEAST(MAGNITUDE(step), 80.0f) : 0.0f;
    return exponential(-edge) / ROOT(du * du + dv * dv + 1e-4f);
}

/* The linear system of one warp, for the whole flow (not the increment). */
__kernel void flow_system(int4 grid, int pitch, /* run size: pitch, 2 grid.y, ways */
                          float smoothness, float contrast,
                          __global float *board) /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
{
    const int row = get_global_id(1), colour = row >= grid.y, y = row - colour * grid.y;
    if (row >= 2 * grid.y)
        return;
    board += get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch;
    const flow_places p = flow_around(get_global_id(0), y, colour, grid, pitch);
    const bool inside = p.x < grid.x; /* beyond, all has to stay 0 */
    const float share = inside ? 0.0625f : 0.0f, above = y > 0 ? share : 0.0f, below = y + 1 < grid.y ? share : 0.0f;
    const float u = board[BOARD_U * pitch + p.at], v = board[BOARD_V * pitch + p.at];
    const float j11 = flow_window(board + BOARD_J11 * pitch, p, share, above, below);
    const float j12 = flow_window(board + BOARD_J12 * pitch, p, share, above, below);
    const float j22 = flow_window(board + BOARD_J22 * pitch, p, share, above, below);
    const float j13 = flow_window(board + BOARD_J13 * pitch, p, share, above, below);
    const float j23 = flow_window(board + BOARD_J23 * pitch, p, share, above, below);
    const float east = inside && (WRAPS || p.x + 1 < grid.x) ? smoothness : 0.0f;
    const float west = inside && (WRAPS || p.x > 0) ? smoothness : 0.0f;
    const float south = inside && y + 1 < grid.y ? smoothness : 0.0f, north = inside && y > 0 ? smoothness : 0.0f;
    board_solve(board + p.at, pitch, (float3)(j11, j12, j22), (float2)(j11 * u + j12 * v - j13, j12 * u + j22 * v - j23),
                (float4)(east * flow_link(board, pitch, p.at, p.east, contrast),
                         west * flow_link(board, pitch, p.at, p.west, contrast),
                         south * flow_link(board, pitch, p.at, p.south, contrast),
                         north * flow_link(board, pitch, p.at, p.north, contrast)));
}

/* Pixel k of a row and colour, relaxed by red-black successive over-relaxation. */
static inline void flow_relaxed(int k, int y, int colour, float relaxation, int4 grid, int pitch,
                                __global float *board) {
    /* across a border that does not wrap the weights are 0 */
    const flow_places p = flow_around(k, y, colour, grid, pitch);
    __global float *u = board + BOARD_U * pitch, *v = board + BOARD_V * pitch;
    __global const float *to_east = board + BOARD_EAST * pitch, *to_south = board + BOARD_SOUTH * pitch;
    const float e = to_east[p.at], w = to_east[p.west], s = to_south[p.at], n = y > 0 ? to_south[p.north] : 0.0f;
    const float b1 = board[BOARD_B1 * pitch + p.at] + e * u[p.east] + w * u[p.west] + s * u[p.south] + n * u[p.north];
    const float b2 = board[BOARD_B2 * pitch + p.at] + e * v[p.east] + w * v[p.west] + s * v[p.south] + n * v[p.north];
    const float cross = board[BOARD_CROSS * pitch + p.at];
    float fu = u[p.at], fv = v[p.at];
    fu += relaxation * ((b1 - cross * fv) * board[BOARD_R1 * pitch + p.at] - fu);
    fv += relaxation * ((b2 - cross * fu) * board[BOARD_R2 * pitch + p.at] - fv);
    u[p.at] = fu;
    v[p.at] = fv;
}

/* One half-sweep. */
__kernel void flow_relax(int4 grid, int pitch, /* run size: pitch, grid.y, ways */
                         int colour, float relaxation,
                         __global float *board) /* (ways, 2, grid.y, BOARD_PLANES, pitch); its flow is changed */
{
    const int y = get_global_id(1);
    if (y >= grid.y)
        return;
    board += get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch;
    flow_relaxed(get_global_id(0), y, colour, relaxation, grid, pitch, board);
}

/* All half-sweeps of a small board, each way's by one work-group: a graphics card starts more slowly than it does
   them. */
__kernel void flow_relax_small(int4 grid, int pitch, /* run size: a work-group (columns, rows), ways */
                               int sweeps, float relaxation,
                               __global float *board) /* (ways, 2, grid.y, BOARD_PLANES, pitch); its flow is changed */
{
    board += get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch;
    for (int half_sweep = 0; half_sweep < 2 * sweeps; ++half_sweep) {
        for (int y = get_local_id(1); y < grid.y; y += get_local_size(1))
            for (int k = get_local_id(0); 2 * k < grid.x; k += get_local_size(0)) /* a row ends with zeros */
                flow_relaxed(k, y, half_sweep & 1, relaxation, grid, pitch, board);
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

/* The flow of boards. */
__kernel void flow_solution(__global const float *board, /* (ways, 2, grid.y, BOARD_PLANES, pitch) */
                            int4 grid, int pitch,        /* run size: grid.x, grid.y, ways */
                            int first,                   /* the first of these ways */
                            __global float2 *flows)      /* (2, grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    board += get_global_id(2) * 2 * grid.y * BOARD_PLANES * pitch + board_index(x, y, grid, pitch);
    flows[((first + get_global_id(2)) * grid.y + y) * grid.x + x] =
        (float2)(board[BOARD_U * pitch], board[BOARD_V * pitch]);
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
__kernel void flow_median(__global const float2 *flow, /* (ways, grid.y, grid.x) */
                          int4 grid,                   /* run size: grid.x / FLOW_CHUNK, rounded up, grid.y, ways */
                          int first,                   /* the first of these ways */
                          __global float2 *median)     /* (ways, grid.y, grid.x) */
{
    const int y = get_global_id(1), x = get_global_id(0) * FLOW_CHUNK;
    if (x >= grid.x || y >= grid.y)
        return;
    flow += (first + get_global_id(2)) * grid.y * grid.x;
    median += (first + get_global_id(2)) * grid.y * grid.x;
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
__kernel void flow_expand(__global const float2 *coarse, /* (ways, grid.y, grid.x) px of the coarse level */
                          int4 grid,                     /* of the coarse level */
                          __global float2 *fine,         /* (ways, size.y, size.x) px of the fine level */
                          int2 size)                     /* run size: size.x, size.y, ways */
{
    const int x = get_global_id(0), y = get_global_id(1), way = get_global_id(2);
    if (x >= size.x || y >= size.y)
        return;
    const float2 q = 0.5f * (float2)(x + 0.5f, y + 0.5f);
    fine[(way * size.y + y) * size.x + x] = 2.0f * bilinear_flow(coarse + way * grid.y * grid.x, q, grid);
}
