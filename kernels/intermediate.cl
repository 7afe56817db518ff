/* The flow of a pair of layers, a and b, as it passes through each place between them. A chart's pixel p has a share s
   of b: the flow V(p) comes from p - s V(p), where layer a shows what is to be at p, and goes to p + (1 - s) V(p),
   where layer b shows it. */

/* Squared px of a chart: the difference of the two flows that start at a place up to which there is nothing to choose;
   and the misses at the ends of a motion that give it half of the largest doubt. */
#define INTERMEDIATE_ALIKE 1.0f
#define INTERMEDIATE_OFF 16.0f
/* Doubt is from 1 to one more than this; a motion is weighted by the square of the other one's. */
#define INTERMEDIATE_DOUBT 6.0f

/* Squared px of a chart: how far a consistent flow may miss its start, and a trusted motion the flows at its ends; and
   by how much a motion has to differ from what is there already. */
#define INTERMEDIATE_TRUSTED 4.0f
#define INTERMEDIATE_APART 4.0f
/* The part of a squared difference on which two launches surely agree. */
#define INTERMEDIATE_SAME 0.99999f
/* Steps in which it is found where a flow passes. */
#define INTERMEDIATE_STEPS 4
/* So many of a pixel and its eight neighbours have to be alike for what passes it to be kept, and so many of its
   neighbours to be kept for it to take over their mean. */
#define INTERMEDIATE_KEEP 4
#define INTERMEDIATE_GROW 3

/* Coefficients below this tell nothing. */
#define INTERMEDIATE_LEAST 1e-5f

/* The coefficient of a layer in the pixel of the working grid in which p lies; 0 where it has none. */
static inline float intermediate_coefficient(__global const float *blend, int4 box, int2 p, int4 border) {
    const int at = grid_border(&p, border) ? box_index(p, box) : -1;
    return at < 0 ? 0.0f : blend[at];
}

/* Pixels of a row that a work item takes: compilers for CPUs make vectors only of what is written as vectors. */
#define INTERMEDIATE_CHUNK 4

/* The share of layer b in what both show; a half where none of them shows anything. */
__kernel void intermediate_share(__global const float *blend_a, int4 box_a, /* (box_a.w, box_a.z) w_a, its place */
                                 __global const float *blend_b, int4 box_b, /* (box_b.w, box_b.z) w_b, its place */
                                 int4 border, float4 lonlat,                /* working grid */
                                 int4 grid, float16 chart,                  /* chart; run size, its columns by
                                                                               INTERMEDIATE_CHUNK, rounded up */
                                 __global float *share)                     /* (grid.y, grid.x) */
{
    const int x = get_global_id(0) * INTERMEDIATE_CHUNK, y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float4 py;
    const float4 u = convert_float4(x + (int4)(0, 1, 2, 3)) + 0.5f;
    const float4 px = chart_places(u, (float4)(y + 0.5f), &chart, lonlat, &py);
    const float2 places[INTERMEDIATE_CHUNK] = {(float2)(px.x, py.x), (float2)(px.y, py.y), (float2)(px.z, py.z),
                                               (float2)(px.w, py.w)};
    for (int k = 0; k < INTERMEDIATE_CHUNK && x + k < grid.x; ++k) {
        const int2 p = floor_int2(places[k]);
        const float a = intermediate_coefficient(blend_a, box_a, p, border);
        const float b = intermediate_coefficient(blend_b, box_b, p, border);
        share[y * grid.x + x + k] = a + b > INTERMEDIATE_LEAST ? b / (a + b) : 0.5f;
    }
}

/* How far the flows at the ends of a motion through u miss it, squared px: in x F_ab where it comes from, in y F_ba
   where it goes to. */
static inline float2 intermediate_off(__global const float2 *flow, __global const float2 *back, float2 u, float2 way,
                                      float share, int4 grid) {
    return (float2)(square2(bilinear_flow(flow, u - share * way, grid) - way),
                    square2(bilinear_flow(back, u + (1.0f - share) * way, grid) + way));
}

static inline float intermediate_doubt(float2 off) {
    const float both = off.x + off.y;
    return 1.0f + INTERMEDIATE_DOUBT * both * both / (both * both + INTERMEDIATE_OFF * INTERMEDIATE_OFF);
}

/* The flow that passes through a place, estimated from the two that start there. With g a flow's gradient along itself
   and f its length, F_ab misses V by g f s, and -F_ba misses it on the other side by g f (1 - s). So F_ab is weighted
   by 1 - s and -F_ba by s, by which both errors cancel. At the outlines of things that hide others flow changes by a
   step: one of the two may be the thing's, the other that of what is behind. The one counts that is the same at both
   ends. */
__kernel void intermediate_direct(__global const float2 *flow, /* (grid.y, grid.x) F_ab, px */
                                  __global const float2 *back, /* (grid.y, grid.x) F_ba, px */
                                  int4 grid,                   /* chart; run size */
                                  __global const float *share, /* (grid.y, grid.x) */
                                  __global float2 *direct)     /* (grid.y, grid.x) px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    const float2 u = (float2)(x + 0.5f, y + 0.5f), first = flow[at], second = -back[at];
    const float s = share[at];
    float part = 1.0f - s;
    if (square2(first - second) > INTERMEDIATE_ALIKE) {
        const float doubt = intermediate_doubt(intermediate_off(flow, back, u, first, s, grid));
        const float doubt_back = intermediate_doubt(intermediate_off(flow, back, u, second, s, grid));
        const float its = part * doubt_back * doubt_back, rest = s * doubt * doubt;
        part = its / (its + rest);
    }
    direct[at] = part * first + (1.0f - part) * second;
}

/* The pixel of a chart in which u lies, or the nearest one. */
static inline int intermediate_nearest(float2 u, int4 grid) {
    const int2 p = floor_int2(u);
    return grid_index((int2)(grid.z ? p.x : LIMITED(p.x, 0, grid.x - 1), LIMITED(p.y, 0, grid.y - 1)), grid);
}

/* Where a consistent flow passes: the first of the four pixels around that place, by its number in a grid that has one
   column and one row more, in front; -1 for other flows. */
__kernel void intermediate_follow(__global const float2 *flow, /* (grid.y, grid.x) F_ab, px */
                                  __global const float2 *back, /* (grid.y, grid.x) F_ba, px */
                                  int4 grid,                   /* chart; run size: grid.x, grid.y, 2 */
                                  __global const float *share, /* (grid.y, grid.x) of b */
                                  __global int *places)        /* (2, grid.y, grid.x) of F_ab and of F_ba */
{
    const int x = get_global_id(0), y = get_global_id(1), other = get_global_id(2);
    if (x >= grid.x || y >= grid.y)
        return;
    const int pixel = y * grid.x + x, at = other * grid.x * grid.y + pixel;
    const float2 f = other ? back[pixel] : flow[pixel], start = (float2)(x + 0.5f, y + 0.5f);
    places[at] = -1;
    if (!(square2(f) > INTERMEDIATE_ALIKE &&
          square2(f + bilinear_flow(other ? flow : back, start + f, grid)) < INTERMEDIATE_TRUSTED))
        return; /* nor for what is not a number */
    float2 u = start;
    for (int step = 0; step < INTERMEDIATE_STEPS; ++step) {
        const float s = share[intermediate_nearest(u, grid)];
        u = start + (other ? 1.0f - s : s) * f;
    }
    int2 corner = floor_int2(u - 0.5f);
    if (grid.z)
        corner.x = (corner.x % grid.x + grid.x) % grid.x;
    if (corner.x >= -1 && corner.x < grid.x && corner.y >= -1 && corner.y < grid.y)
        places[at] = (corner.y + 1) * (grid.x + 1) + corner.x + 1;
}

/* Where a thing that is narrower than its motion passes, no flow that starts there is the thing's. So each consistent
   flow is offered to the four pixels around the place through which it passes. Of those offered that differ from what
   is there already a pixel takes the one that differs most. A first call finds by how much that differs, a second one
   which flow it is. */
__kernel void intermediate_pass(__global const float2 *flow, /* (grid.y, grid.x) F_ab, px */
                                __global const float2 *back, /* (grid.y, grid.x) F_ba, px */
                                int4 grid,                   /* chart; run size: grid.x, grid.y, 2 */
                                __global const int *places,  /* (2, grid.y, grid.x) of intermediate_follow */
                                __global const float2 *passing, /* (grid.y, grid.x) what is there, from a to b */
                                int named,                   /* 0: the difference is found; 1: whose it is */
                                __global uint *furthest,     /* (grid.y, grid.x) bits of the squared difference */
                                __global uint *source)       /* (grid.y, grid.x) 0: none; 1 + pixel, of b: + all */
{
    const int x = get_global_id(0), y = get_global_id(1), other = get_global_id(2);
    if (x >= grid.x || y >= grid.y)
        return;
    const int pixel = y * grid.x + x, at = other * grid.x * grid.y + pixel, place = places[at];
    if (place < 0)
        return;
    const float2 f = other ? -back[pixel] : flow[pixel];
    const int2 corner = (int2)(place % (grid.x + 1), place / (grid.x + 1)) - 1;
    for (int tap = 0; tap < 4; ++tap) {
        const int there = grid_index(corner + (int2)(tap & 1, tap >> 1), grid);
        if (there < 0)
            continue;
        const float apart = square2(f - passing[there]);
        if (!(apart > INTERMEDIATE_APART))
            continue;
        /* of numbers above 0, those that are larger have larger bits */
        if (!named)
            atomic_max(furthest + there, as_uint(apart));
        else if (apart >= INTERMEDIATE_SAME * as_float(furthest[there]))
            atomic_max(source + there, (uint)(1 + at));
    }
}

/* How surely, 0 to 2, the first of two flows that pass through u hides the other one: in how many layers the other
   starts and leads to where the first one's thing is in the other layer, which hides there what is seen here. */
static inline int intermediate_hides(__global const float2 *flow, __global const float2 *back, float2 u, float2 way,
                                     float2 hidden, float share, int4 grid) {
    const float2 a = u - share * way, b = a + way;
    return (square2(bilinear_flow(flow, b - hidden, grid) - hidden) < INTERMEDIATE_TRUSTED) +
           (square2(bilinear_flow(back, a + hidden, grid) + hidden) < INTERMEDIATE_TRUSTED);
}

/* What passes replaces what is there already if it agrees with the flows at both of its ends, and that does not, or is
   hidden by it. A pixel is offered one flow alone; where outlines meet, that of what is behind may differ most. So
   there is another round, in which that is there and may be hidden. */
__kernel void intermediate_choose(__global const float2 *flow,    /* (grid.y, grid.x) F_ab, px */
                                  __global const float2 *back,    /* (grid.y, grid.x) F_ba, px */
                                  int4 grid,                      /* chart; run size */
                                  __global const float *share,    /* (grid.y, grid.x) */
                                  __global const uint *source,    /* (grid.y, grid.x) of intermediate_pass */
                                  __global float2 *passing,       /* (grid.y, grid.x) what is there, in place */
                                  __global uchar *seen)           /* (grid.y, grid.x) 1 where something passes */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x, all = grid.x * grid.y, from = (int)source[at] - 1;
    if (from < 0)
        return;
    const float2 u = (float2)(x + 0.5f, y + 0.5f), there = passing[at];
    const float2 way = from < all ? flow[from] : -back[from - all];
    const float s = share[at];
    const float2 off = intermediate_off(flow, back, u, way, s, grid);
    if (!(GREATEST(off.x, off.y) < INTERMEDIATE_TRUSTED))
        return;
    const float2 its = intermediate_off(flow, back, u, there, s, grid);
    if (GREATEST(its.x, its.y) < INTERMEDIATE_TRUSTED &&
        intermediate_hides(flow, back, u, way, there, s, grid) <= intermediate_hides(flow, back, u, there, way, s, grid))
        return;
    passing[at] = way;
    seen[at] = 1;
}

/* What passes single pixels, unlike what is around, is chance: it is not kept. */
__kernel void intermediate_keep(__global const float2 *passing, /* (grid.y, grid.x) what is there, px */
                                __global const uchar *seen,     /* (grid.y, grid.x) where that is what passes */
                                int4 grid,                      /* chart; run size */
                                __global uchar *kept)           /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    int alike = 0;
    for (int j = -1; j <= 1 && seen[at]; ++j)
        for (int i = -1; i <= 1; ++i) {
            const int beside = grid_index((int2)(x + i, y + j), grid);
            alike += beside >= 0 && square2(passing[beside] - passing[at]) < INTERMEDIATE_APART;
        }
    kept[at] = alike >= INTERMEDIATE_KEEP;
}

/* What passes where it is kept, and its mean beside that: holes are filled, and outlines are a pixel further out, where
   the photos have their soft edge. In both directions, as flows at p itself. */
__kernel void intermediate_fill(__global const float2 *direct,  /* (grid.y, grid.x) what starts there, px */
                                __global const float2 *passing, /* (grid.y, grid.x) what passes, px */
                                __global const uchar *kept,     /* (grid.y, grid.x) where that is seen */
                                int4 grid,                      /* chart; run size */
                                __global float2 *forward,       /* (grid.y, grid.x) V, px */
                                __global float2 *backward)      /* (grid.y, grid.x) -V, px */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    const int at = y * grid.x + x;
    float2 way = kept[at] ? passing[at] : direct[at], sum = (float2)(0.0f);
    int count = 0;
    for (int j = -1; j <= 1 && !kept[at]; ++j)
        for (int i = -1; i <= 1; ++i) {
            const int beside = grid_index((int2)(x + i, y + j), grid);
            if (beside >= 0 && kept[beside]) {
                sum += passing[beside];
                ++count;
            }
        }
    if (count >= INTERMEDIATE_GROW)
        way = sum / (float)count;
    forward[at] = way;
    backward[at] = -way;
}
