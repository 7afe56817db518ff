/* Where aligned layers show different things, how they differ tells nothing of exposure: it is extrapolated from
   beside. Layers are levels of multiband.cl: arrays on a box of a grid. */

/* The brightest channel, of an integer image, up to which what a layer shows may be the dark of anything, as at the rim
   of a lens, and from which on it surely is something. */
#define CONTENT_BLACK 0.03f
#define CONTENT_SEEN 0.15f

/* Least share of the other layers, below which nothing is known of them. */
#define CONTENT_LITTLE 1e-3f

/* How surely layers show the same at a place of a grid, 0..1. d: how one of them differs from the mean of all, of
   which `rest` is the others' share. */
static inline float content_same(float3 d, float3 mean, float rest, float2 place, __global const float *moved,
                                 __global const float *other, int4 cells, float shoulder) {
    const float3 own = mean + d, others = own - d / GREATEST(rest, CONTENT_LITTLE);
    const float seen = shoulder > 0.0f ? ramp(darker_channel(own, others), CONTENT_BLACK, CONTENT_SEEN) : 1.0f;
    const float surely = seen * bilinear_scalar(other, place, cells);
    return 1.0f - GREATEST(surely, bilinear_scalar(moved, place, cells));
}

/* Sums for a fit, over the pixels of a cell: with d = (1 - share) e the difference of a layer from the mean of all, of
   which its own share is part, of w d (1 - share) / n and w (1 - share)^2 / n, w as surely as it shows the same. */
__kernel void content_gather(__global const float4 *difference,  /* (box.w, box.z): colour, valid */
                             __global const float *share,        /* (box.w, box.z), in the mean */
                             int4 box, int4 grid,                /* place; its grid */
                             __global const float4 *mean,        /* (grid.y, grid.x): colour, valid */
                             __global const float *moved,        /* (cells.y, cells.x), 0..1 */
                             __global const float *other,        /* the same, of what is not too dark to tell */
                             int4 cells,                         /* run size; over the same region */
                             float shoulder,                     /* of the exposure scale */
                             __global float4 *sums)              /* (cells.y, cells.x): r, g, b, weight */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    const int4 its = cell_pixels(cx, cy, grid, cells);
    float4 sum = (float4)(0.0f);
    for (int y = its.y; y < its.w; ++y)
        for (int x = its.x; x < its.z; ++x) {
            const int at = box_index((int2)(x, y), box);
            if (at < 0 || difference[at].w == 0.0f)
                continue;
            const float3 d = difference[at].xyz, m = mean[y * grid.x + x].xyz;
            const float2 place = grid_place(x, y, grid, cells);
            const float rest = 1.0f - share[at];
            const float w = rest * content_same(d, m, rest, place, moved, other, cells, shoulder);
            sum += w * (float4)(d, rest);
        }
    const int n = (its.z - its.x) * (its.w - its.y);
    sums[cy * cells.x + cx] = sum / GREATEST(n, 1);
}

/* In place of a difference where layers show different things, that which the cells tell: e of the fit, as far as that
   is sure. */
__kernel void content_complete(__global float4 *difference, __global const float *share, /* (box.w, box.z) */
                               int4 box, int4 grid, /* place, run size; its grid */
                               __global const float4 *mean, __global const float *moved, __global const float *other,
                               __global const float4 *expected, /* (cells.y, cells.x): e, and how sure, 0..1 */
                               int4 cells, float shoulder)
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w || difference[at].w == 0.0f)
        return;
    const float2 place = grid_place(x + box.x, y + box.y, grid, cells);
    const float3 d = difference[at].xyz, m = mean[(y + box.y) * grid.x + x + box.x].xyz;
    const float rest = 1.0f - share[at];
    const float4 e = bilinear_colour(expected, place, cells);
    const float part = e.w * (1.0f - content_same(d, m, rest, place, moved, other, cells, shoulder));
    if (part > 0.0f)
        difference[at].xyz = (1.0f - part) * d + part * rest * e.xyz;
}
