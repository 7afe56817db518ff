/* Where the geometry changes over from one layer to the next.

   Shares. In each cell of a grid the layers that cover it have shares, which sum to 1: share[s] is that of layer
   owner[s], and a cell's are those from first[cell] to first[cell + 1], by ascending layer. */

/* Kept of every share, so that the shares of a place never sum to 0: of layers that a coarser grid does not have there,
   and where only layers are that have no share beside it. */
#define TRANSITION_TRACE 1e-6f

/* The well of a cell weakens its links to no less than this part of them: else its parabola would have no minimum. */
#define TRANSITION_WEAKEST 0.25f

/* Slopes, of full scale per working px, up to which nobody sees what is bent, and from which on everybody does. */
#define TRANSITION_PLAIN 0.012f
#define TRANSITION_TEXTURED 0.035f

/* Squared strain of a flow from which on the picture is torn: by more it is no worse. */
#define TRANSITION_TORN 1.0f

/* Cells of a displacement that are looked at, about. */
#define TRANSITION_FAR 64.0f

/* A layer's texture in each cell: the steepest slope of r, g or b, of full scale per working px, by Sobel's operator. */
__kernel void transition_texture(__global const float4 *layer, /* (box.w, box.z) r, g, b, valid */
                                 int4 box, int4 border,        /* place on the working grid; the grid */
                                 int4 cells, int4 place,       /* their grid; those that the layer is in, run size */
                                 __global float *texture)      /* (place.w, place.z) */
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= place.z || row >= place.w)
        return;
    const int4 its = cell_pixels(column + place.x, row + place.y, border, cells);
    const int rim = border.z && box.z == border.x ? 0 : 1; /* all round, the outermost columns are neighbours */
    const int left = max(its.x - box.x, rim), right = min(its.z - box.x, box.z - rim);
    const int top = max(its.y - box.y, 1), bottom = min(its.w - box.y, box.w - 1);
    float steepest = 0.0f;
    for (int y = top; y < bottom; ++y)
        for (int x = left; x < right; ++x) {
            __global const float4 *p = layer + y * box.z + x;
            const int west = x > 0 ? -1 : box.z - 1, east = x + 1 < box.z ? 1 : 1 - box.z;
            const float4 a = p[west - box.z], b = p[-box.z], c = p[east - box.z], d = p[west], f = p[east],
                         g = p[west + box.z], h = p[box.z], i = p[east + box.z];
            if (a.w * b.w * c.w * d.w * f.w * g.w * h.w * i.w == 0.0f)
                continue;
            const float3 across = 0.125f * (c + 2.0f * f + i - a - 2.0f * d - g).xyz;
            const float3 down = 0.125f * (g + 2.0f * h + i - a - 2.0f * b - c).xyz;
            const float3 squared = across * across + down * down;
            steepest = GREATEST(steepest, GREATEST(GREATEST(squared.x, squared.y), squared.z));
        }
    texture[row * place.z + column] = ROOT(steepest);
}

/* The largest texture that a layer may show at position p of the working grid, which displacements up to `end` - p lead
   to: of the cells along the way and beside it. */
static inline float transition_met(__global const float *texture, int4 place, float2 p, float2 end, int4 border,
                                   float4 lonlat, int4 cells) {
    float2 way = end - p;
    way.x -= whole_turns(way.x, lonlat.y == 0.0f && border.z ? border.x : canvas_turn(lonlat));
    const float2 ratio = grid_ratio(border, cells);
    const int steps = 1 + (int)LEAST(GREATEST(MAGNITUDE(way.x * ratio.x), MAGNITUDE(way.y * ratio.y)), TRANSITION_FAR);
    float met = 0.0f;
    for (int step = 0; step <= steps; ++step) {
        const int2 at = floor_int2((p + way * ((float)step / steps)) * ratio);
        for (int beside = 0; beside < 9; ++beside) {
            int2 cell = at + (int2)(beside % 3 - 1, beside / 3 - 1);
            const int index = grid_border(&cell, cells) ? box_index(cell, place) : -1;
            met = GREATEST(met, index < 0 ? 0.0f : texture[index]);
        }
    }
    return met;
}

/* A flow where it is known: beside the outermost pixels it is theirs. */
static inline float2 transition_flow(__global const float2 *flow, float2 u, int4 grid) {
    const float2 within = LIMITED(u, (float2)(0.5f), (float2)(grid.x - 0.5f, grid.y - 0.5f));
    return bilinear_flow(flow, (float2)(grid.z ? u.x : within.x, within.y), grid);
}

/* The squared strain of a flow: how it differs from place to place, over two px. */
static inline float transition_strain(__global const float2 *flow, float2 u, int4 grid) {
    const float2 right = (float2)(1.0f, 0.0f), below = (float2)(0.0f, 1.0f);
    const float2 across = transition_flow(flow, u + right, grid) - transition_flow(flow, u - right, grid);
    const float2 down = transition_flow(flow, u + below, grid) - transition_flow(flow, u - below, grid);
    return LEAST(0.25f * (square2(across) + square2(down)), TRANSITION_TORN);
}

/* Squared parallax of a pair in cells, in working px: the longest flow, either way, at places where both layers are;
   and the mean squared strain of both ways, 0 at other places. As far as they are seen: what shows nothing may be
   bent. */
__kernel void transition_parallax(__global const float2 *flow,   /* chart grid, px: F_ab */
                                  __global const float2 *back,   /* chart grid, px: F_ba */
                                  int4 grid, float16 chart,      /* chart */
                                  __global const uchar *mask_a,  /* (masks.y, masks.x) */
                                  __global const uchar *mask_b,  /* (masks.y, masks.x) */
                                  int4 masks,                    /* mask grid */
                                  __global const float *texture_a, int4 place_a, /* (place.w, place.z) */
                                  __global const float *texture_b, int4 place_b, /* of transition_texture */
                                  int4 border, float4 lonlat,    /* working grid */
                                  int4 cells,                    /* run size */
                                  __global float *parallax,      /* (cells.y, cells.x) those of no pair before are */
                                  __global float *strain)        /* (cells.y, cells.x) less */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cells.x || y >= cells.y)
        return;
    const float2 size = (float2)(border.x, border.y), unit = (float2)(lonlat.y == 0.0f ? 1.0f : 1.0f / lonlat.y);
    const float2 per_pixel = unit / (float2)(chart.s9, chart.sa);
    float longest = 0.0f, bent = 0.0f;
    for (int part = 0; part < 4; ++part) {
        const float2 share = ((float2)(x, y) + 0.25f + 0.5f * (float2)(part & 1, part >> 1)) /
                             (float2)(cells.x, cells.y);
        const int2 m = floor_int2(share * (float2)(masks.x, masks.y));
        if (!mask_a[m.y * masks.x + m.x] || !mask_b[m.y * masks.x + m.x])
            continue;
        const float2 u = chart_position(canvas_point(share * size, lonlat), &chart);
        longest = GREATEST(longest, square2(bilinear_flow(flow, u, grid) * per_pixel));
        longest = GREATEST(longest, square2(bilinear_flow(back, u, grid) * per_pixel));
        bent += 0.125f * (transition_strain(flow, u, grid) + transition_strain(back, u, grid));
    }
    const int at = y * cells.x + x;
    if (longest > parallax[at] || bent > strain[at]) {
        const float2 p = grid_place(x, y, cells, border);
        const float2 u = chart_position(canvas_point(p, lonlat), &chart);
        const float2 to_a = canvas_position(chart_point(u + bilinear_flow(back, u, grid), &chart), lonlat);
        const float2 to_b = canvas_position(chart_point(u + bilinear_flow(flow, u, grid), &chart), lonlat);
        const float met = GREATEST(transition_met(texture_a, place_a, p, to_a, border, lonlat, cells),
                                   transition_met(texture_b, place_b, p, to_b, border, lonlat, cells));
        const float seen = ramp(met, TRANSITION_PLAIN, TRANSITION_TEXTURED);
        parallax[at] = GREATEST(parallax[at], longest * seen * seen);
        strain[at] = GREATEST(strain[at], bent * seen * seen);
    }
}

/* The share of a layer in a cell; 0 where it has none. */
static inline float transition_share(__global const float *share, __global const int *first,
                                     __global const int *owner, int cell, int layer) {
    const int end = first[cell + 1];
    for (int s = first[cell]; s < end; ++s)
        if (owner[s] == layer)
            return share[s];
    return 0.0f;
}

/* A layer's share between the cells of a grid; cells without any count as 0. */
static inline float transition_read(__global const float *share, __global const int *first,
                                    __global const int *owner, float2 q, int4 cells, int layer) {
    const int2 corner = floor_int2(q - 0.5f);
    int4 at;
    const float4 w = grid_taps(corner, q - 0.5f - convert_float2(corner), cells, &at);
    return w.x * transition_share(share, first, owner, at.x, layer) +
           w.y * transition_share(share, first, owner, at.y, layer) +
           w.z * transition_share(share, first, owner, at.z, layer) +
           w.w * transition_share(share, first, owner, at.w, layer);
}

/* Shares from those of a coarser grid over the same region. */
__kernel void transition_refine(__global const float *coarse,       /* shares of the coarser grid */
                                __global const int *coarse_first, __global const int *coarse_owner,
                                int4 coarse_cells,                  /* coarser grid */
                                __global const int *first, __global const int *owner,
                                int4 cells,                         /* run size */
                                __global float *share)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cells.x || y >= cells.y)
        return;
    const int begin = first[y * cells.x + x], end = first[y * cells.x + x + 1];
    const float2 q = ((float2)(x, y) + 0.5f) * grid_ratio(cells, coarse_cells);
    float total = 0.0f;
    for (int s = begin; s < end; ++s) {
        share[s] = TRANSITION_TRACE +
                   transition_read(coarse, coarse_first, coarse_owner, q, coarse_cells, owner[s]);
        total += share[s];
    }
    for (int s = begin; s < end; ++s)
        share[s] /= total;
}

/* The nearest shares that sum to 1, none below 0: those above a threshold, less it. */
static inline void transition_project(__global float *share, int begin, int end) {
    float threshold = -INFINITY;
    for (int left = end - begin + 1;;) {
        float excess = -1.0f;
        int count = 0;
        for (int s = begin; s < end; ++s)
            if (share[s] > threshold) {
                excess += share[s];
                ++count;
            }
        if (count == 0 || count >= left) /* fewer each time, so that rounding keeps nothing going */
            break;
        left = count;
        threshold = excess / count;
    }
    for (int s = begin; s < end; ++s)
        share[s] = GREATEST(share[s] - threshold, 0.0f);
}

/* One step of successive over-relaxation towards the least of

       sum of links (w_k - w_k')^2  +  sum of cells, well w_k (1 - w_k),

   of all layers' shares w_k, in the cells of one colour of a chequerboard. In a cell that is a parabola, the same for
   all its layers, so that the nearest shares to where each has its least are the best. */
__kernel void transition_relax(__global float *share,       /* in place */
                               __global const int *first, __global const int *owner,
                               int4 cells,                  /* run size: half the columns, rounded up; rows */
                               __global const float *east,  /* (cells.y, cells.x) links to the next column, */
                               __global const float *south, /* (cells.y, cells.x) to the next row; 0: none */
                               __global const float *well,  /* (cells.y, cells.x) */
                               float depth,                 /* part of the well that counts */
                               int colour,                  /* 0 or 1 */
                               float relaxation)            /* 1 to 2 */
{
    const int y = get_global_id(1), x = 2 * get_global_id(0) + ((y + colour) & 1);
    if (x >= cells.x || y >= cells.y)
        return;
    const int at = y * cells.x + x, begin = first[at], end = first[at + 1];
    if (end - begin < 2)
        return;
    const int left = x > 0 ? at - 1 : at + cells.x - 1, right = x + 1 < cells.x ? at + 1 : at - x;
    const int up = y > 0 ? at - cells.x : at, down = y + 1 < cells.y ? at + cells.x : at;
    /* a last column's link leads around the canvas, or is 0 */
    const float4 link = (float4)(east[left], east[at], y > 0 ? south[up] : 0.0f, south[at]);
    const float sum = link.x + link.y + link.z + link.w;
    if (sum <= 0.0f)
        return;
    const float scale = 1.0f / GREATEST(sum - depth * well[at], TRANSITION_WEAKEST * sum);
    for (int s = begin; s < end; ++s) {
        const int k = owner[s];
        const float pull = link.x * transition_share(share, first, owner, left, k) +
                           link.y * transition_share(share, first, owner, right, k) +
                           link.z * transition_share(share, first, owner, up, k) +
                           link.w * transition_share(share, first, owner, down, k);
        share[s] += relaxation * (pull * scale - share[s]);
    }
    transition_project(share, begin, end);
}

/* w_k from the shares, where several layers are. They still have to sum to 1. */
__kernel void transition_expand(__global float *blend,            /* (box.w, box.z) w_k, in place */
                                int4 box, int4 border,            /* place on the working grid, run size; the grid */
                                __global const float *share, __global const int *first,
                                __global const int *owner,
                                int4 cells,                       /* over the same region */
                                int layer,                        /* k */
                                __global float *total)            /* (border.y, border.x) sum over layers */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    float w = blend[at];
    if (w > 0.0f && w < 1.0f) {
        const float2 q = ((float2)(x + box.x, y + box.y) + 0.5f) * grid_ratio(border, cells);
        w = transition_read(share, first, owner, q, cells, layer);
        w = GREATEST(w, TRANSITION_TRACE);
    }
    blend[at] = w;
    total[(y + box.y) * border.x + x + box.x] += w;
}
