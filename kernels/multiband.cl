/* A multi-band blend of layers that are aligned, corrected and weighed: what is to be added to each for it. What is
   blended is how the layers differ from a mean of them: where they agree it is nothing. Levels of a layer are
   arrays on a box of a grid, those of the blend on all of it; each grid covers the same region with half as many
   columns and rows as the one before. */

/* The quadratic B-spline: smooth, and values at a distance of 1 from each other sum to 1. */
static inline float multiband_spline(float t) {
    const float a = MAGNITUDE(t), rest = 1.5f - a;
    return a < 0.5f ? 0.75f - a * a : a < 1.5f ? 0.5f * rest * rest : 0.0f;
}

/* Taps that weigh less than this together lie at the spline's very end, where rounding decides on them. */
#define MULTIBAND_NOTHING 1e-4f

/* Pixels that the spline of the next coarser grid reaches over: three times 9 / 4, which 9 pixels are reduced by, and
   the ends. */
#define MULTIBAND_TAPS 8

/* A level at position q of its grid, over the valid pixels around: colour and 1, or zeros. */
static inline float4 multiband_expand(__global const float4 *level, int4 box, float2 q, int4 grid) {
    const int2 middle = floor_int2(q);
    float4 sum = (float4)(0.0f);
    for (int j = -1; j <= 1; ++j)
        for (int i = -1; i <= 1; ++i) {
            int2 p = middle + (int2)(i, j);
            const float t = multiband_spline(p.x + 0.5f - q.x) * multiband_spline(p.y + 0.5f - q.y);
            const int at = grid_border(&p, grid) ? box_index(p, box) : -1;
            if (at >= 0 && level[at].w > 0.0f)
                sum += t * (float4)(level[at].xyz, 1.0f);
        }
    return sum.w > 0.0f ? sum / sum.w : (float4)(0.0f);
}

/* Add a layer's colour weights, where it is valid, to those of all. */
__kernel void multiband_weights(__global const float4 *layer, __global const float4 *field, /* (box.w, box.z) */
                                int4 box, int4 grid,   /* place, run size; working grid */
                                __global float *total) /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w)
        return;
    if (layer[at].w > 0.0f)
        total[(y + box.y) * grid.x + x + box.x] += field[at].w;
}

/* What a layer shows, aligned and corrected, and the share of all weight that is its own, on half the working grid:
   at the corners of four working pixels, as the mean of these. Floats are blended by their logarithms. */
__kernel void multiband_finest(__global const float4 *layer, __global const float4 *field, /* (box.w, box.z) */
                               int4 box, int4 border, float4 lonlat, /* place; working grid */
                               __global const float *total,        /* (border.y, border.x), of multiband_weights */
                               __global const float4 *gain,        /* (colours.y, colours.x) */
                               int4 colours,                       /* colour grid; width 0: no gain */
                               float shoulder,                     /* of the exposure scale */
                               int4 place, int4 grid,              /* on half the working grid, run size; that grid */
                               __global float4 *level,             /* (place.w, place.z): colour, valid */
                               __global float *share)              /* (place.w, place.z) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= place.z || y >= place.w)
        return;
    const float2 q = grid_place(x + place.x, y + place.y, grid, border);
    const int2 corner = floor_int2(q - 0.5f);
    const float2 t = q - 0.5f - convert_float2(corner);
    float4 way = (float4)(0.0f);
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            int2 p = corner + (int2)(i, j);
            const int at = grid_border(&p, border) ? box_index(p, box) : -1;
            const float all = at < 0 ? 0.0f : total[p.y * border.x + p.x];
            if (all > 0.0f && layer[at].w > 0.0f)
                way += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * (float4)(field[at].xyz, field[at].w / all);
        }
    float4 seen = layer_sample(layer, box, layer_position(q, way.xyz, lonlat), border);
    const bool valid = seen.w > 0.0f;
    if (valid && colours.x > 0) {
        const float4 g = bilinear_colour(gain, grid_place(x + place.x, y + place.y, grid, colours), colours);
        seen.xyz = exposure_shift(seen.xyz, g.xyz, shoulder);
    }
    if (shoulder == 0.0f)
        seen.xyz = exposure_scale(seen.xyz, 0.0f);
    level[y * place.z + x] = valid ? (float4)(seen.xyz, 1.0f) : (float4)(0.0f);
    share[y * place.z + x] = valid ? way.w : 0.0f;
}

/* How a layer differs from a mean of all. */
__kernel void multiband_differ(__global float4 *level,      /* (box.w, box.z): colour, valid; then difference */
                               int4 box, int4 grid,         /* place, run size; its grid */
                               __global const float4 *mean) /* (grid.y, grid.x): colour, valid */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w)
        return;
    const float4 c = mean[(y + box.y) * grid.x + x + box.x];
    if (level[at].w > 0.0f)
        level[at] = c.w > 0.0f ? (float4)(level[at].xyz - c.xyz, 1.0f) : (float4)(0.0f);
}

/* Sums over pixels of a level, each with its weight: of what is valid, of shares, of all that the grid has. */
typedef struct {
    float4 colours;
    float share, all;
} multiband_sums;

static inline void multiband_take(multiband_sums *sums, float t, int at, __global const float4 *level,
                                  __global const float *share) {
    const float4 c = level[at];
    sums->all += t;
    sums->colours += t * c.w * (float4)(c.xyz, 1.0f);
    sums->share += t * share[at];
}

/* The same of a pixel of the grid, which may lie beside the level. */
static inline void multiband_tap(multiband_sums *sums, float t, int2 p, int4 grid, __global const float4 *level,
                                 __global const float *share, int4 box) {
    if (!grid_border(&p, grid))
        return;
    const int at = box_index(p, box);
    if (at >= 0)
        multiband_take(sums, t, at, level, share);
    else
        sums->all += t;
}

/* Their means: colours over what is valid, shares over all of the grid. */
static inline void multiband_mean(const multiband_sums *sums, __global float4 *level, __global float *share) {
    const float4 sum = sums->colours;
    *level = sum.w > MULTIBAND_NOTHING ? sum / sum.w : (float4)(0.0f);
    *share = sums->share / sums->all;
}

/* The next coarser level of a layer: colours over what is valid, shares over all of the grid. */
__kernel void multiband_reduce(__global const float4 *level, __global const float *share, /* (box.w, box.z) */
                               int4 box, int4 fine,               /* place on the fine grid; the grid */
                               __global float4 *smaller,          /* (smaller_box.w, smaller_box.z) */
                               __global float *smaller_share,     /* the same */
                               int4 smaller_box, int4 coarse)     /* place on the coarse grid, run size; the grid */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= smaller_box.z || y >= smaller_box.w)
        return;
    const float2 ratio = grid_ratio(coarse, fine);
    const float2 q = grid_place(x + smaller_box.x, y + smaller_box.y, coarse, fine);
    const int2 first = floor_int2(q - 1.5f * ratio), last = floor_int2(q + 1.5f * ratio);
    float across[MULTIBAND_TAPS];
    for (int i = 0; i < MULTIBAND_TAPS; ++i)
        across[i] = multiband_spline((first.x + i + 0.5f - q.x) / ratio.x);
    multiband_sums sums = {(float4)(0.0f), 0.0f, 0.0f};
    const bool inner = first.x >= box.x && first.y >= box.y && last.x < box.x + box.z && last.y < box.y + box.w;
    for (int j = first.y; j <= last.y; ++j) {
        const float down = multiband_spline((j + 0.5f - q.y) / ratio.y);
        for (int i = first.x; i <= last.x; ++i) {
            const float t = down * across[i - first.x];
            if (inner)
                multiband_take(&sums, t, (j - box.y) * box.z + i - box.x, level, share);
            else
                multiband_tap(&sums, t, (int2)(i, j), fine, level, share, box);
        }
    }
    const int at = y * smaller_box.z + x;
    multiband_mean(&sums, smaller + at, smaller_share + at);
}

/* Smooth a level along its rows, which shrink towards a pole: on the sphere it is as smooth in all directions then,
   and what meets at the pole is one. */
__kernel void multiband_spread(__global const float4 *level, __global const float *share, /* (box.w, box.z) */
                               int4 box, int4 grid,          /* place, run size; its grid */
                               __global const float *widths, /* (grid.y) of the spline's knots, columns */
                               __global float4 *spread, __global float *spread_share) /* (box.w, box.z) */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w)
        return;
    const float wide = widths[y + box.y];
    const int reach = (int)(1.5f * wide);
    multiband_sums sums = {(float4)(0.0f), 0.0f, 0.0f};
    const bool inner = x >= reach && x + reach < box.z;
    for (int i = -reach; i <= reach; ++i) {
        const float t = multiband_spline(i / wide);
        if (inner)
            multiband_take(&sums, t, at + i, level, share);
        else
            multiband_tap(&sums, t, (int2)(x + box.x + i, y + box.y), grid, level, share, box);
    }
    multiband_mean(&sums, spread + at, spread_share + at);
}

/* Add what a level of a layer shows beyond the next coarser one to the blend, by its share. */
__kernel void multiband_add(__global const float4 *level, __global const float *share, /* (box.w, box.z) */
                            int4 box, int4 grid,              /* place, run size; its grid */
                            __global const float4 *smaller,   /* (smaller_box.w, smaller_box.z) */
                            int4 smaller_box, int4 coarse,    /* place, grid; width of the grid 0: there is none */
                            __global float4 *sum)             /* (grid.y, grid.x): weighted colours, weights */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w || !(share[at] > 0.0f))
        return;
    const int2 p = (int2)(x + box.x, y + box.y);
    float4 detail = (float4)(level[at].xyz, 1.0f);
    if (coarse.x > 0)
        detail.xyz -= multiband_expand(smaller, smaller_box, grid_place(p.x, p.y, grid, coarse), coarse).xyz;
    sum[p.y * grid.x + p.x] += share[at] * detail;
}

/* A level of the blend, whole: its own detail and the next coarser level. */
__kernel void multiband_join(__global float4 *sum,           /* (grid.y, grid.x) of multiband_add; colour, valid */
                             int4 grid,                      /* run size */
                             __global const float4 *smaller, /* (coarse.y, coarse.x), joined */
                             int4 coarse)                    /* its grid; width 0: there is none */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * grid.x + x;
    if (x >= grid.x || y >= grid.y)
        return;
    const float4 s = sum[at];
    float4 v = s.w > 0.0f ? (float4)(s.xyz / s.w, 1.0f) : (float4)(0.0f);
    if (coarse.x > 0 && v.w > 0.0f)
        v.xyz += multiband_expand(smaller, (int4)(0, 0, coarse.xy), grid_place(x, y, grid, coarse), coarse).xyz;
    sum[at] = v;
}

/* What a level of a layer has to be raised by to be the blend, exactly 0 where that is negligible. Beside the layer
   as much as around, over two pixels: its last ones at full resolution are read between these. */
__kernel void multiband_offset(__global const float4 *level, /* (box.w, box.z) */
                               int4 box, int4 grid,          /* place, run size; its grid */
                               __global const float4 *blend, /* (grid.y, grid.x), joined */
                               float negligible,
                               __global float4 *offset)      /* (box.w, box.z): r, g, b, 0 */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int here = y * box.z + x, reach = level[here].w > 0.0f ? 0 : 2;
    const bool inner = x >= reach && y >= reach && x + reach < box.z && y + reach < box.w;
    float4 near = (float4)(0.0f), sum = near;
    for (int j = -reach; j <= reach; ++j)
        for (int i = -reach; i <= reach; ++i) {
            int2 p = (int2)(x + box.x + i, y + box.y + j);
            const int at = inner ? here + j * box.z + i : grid_border(&p, grid) ? box_index(p, box) : -1;
            if (at < 0 || level[at].w == 0.0f)
                continue;
            const float4 there = blend[p.y * grid.x + p.x];
            const float4 rise = there.w > 0.0f ? (float4)(there.xyz - level[at].xyz, 1.0f) : (float4)(0.0f);
            sum += rise;
            if (i * i <= 1 && j * j <= 1)
                near += rise;
        }
    sum = near.w > 0.0f ? near : sum;
    const float3 d = sum.w > 0.0f ? sum.xyz / sum.w : (float3)(0.0f);
    const float3 size = MAGNITUDE(d), left = size - negligible;
    offset[y * box.z + x] = (float4)(left > 0.0f ? d * (left / size) : (float3)(0.0f), 0.0f);
}
