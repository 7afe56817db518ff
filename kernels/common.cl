/* Rules every kernel shares; put in front of each source by hugin_abflow/compiler.py.

   Frames. A grid is an array of pixels; positions on it are continuous, x right, y down, and pixel (i, j)
   covers [i, i+1) x [j, j+1), so its centre is at (i + 0.5, j + 0.5). "Point" is a place in the scene's
   frame: on a spherical canvas a unit vector (x right, y forward, z up), on a plane (x, y, 0) in canvas
   grid pixels. */

/* Borders of a grid, given as (width, height, wraps, poles): columns are taken modulo the width where the
   grid wraps; a row beyond a pole is the mirrored row half a turn further. Returns false outside. */
static inline bool grid_border(int2 *p, int4 grid) {
    if (p->y < 0 || p->y >= grid.y) {
        if (!(grid.w & (p->y < 0 ? 1 : 2)))
            return false;
        p->y = p->y < 0 ? -1 - p->y : 2 * grid.y - 1 - p->y;
        p->x += grid.x / 2;
        if (p->y < 0 || p->y >= grid.y)
            return false;
    }
    if (p->x < 0 || p->x >= grid.x) {
        if (!grid.z)
            return false;
        p->x %= grid.x;
        p->x += p->x < 0 ? grid.x : 0;
    }
    return true;
}

/* Index of pixel p in an array of the whole grid; -1 outside. */
static inline int grid_index(int2 p, int4 grid) {
    return grid_border(&p, grid) ? p.y * grid.x + p.x : -1;
}

#ifdef PIXEL
/* A pixel of a layer as it is stored: SAMPLES (2 or 4) of type PIXEL, alpha last. */
#define PIXEL_JOIN(type, n) type##n
#define PIXEL_VECTOR(type, n) PIXEL_JOIN(type, n)
typedef PIXEL_VECTOR(PIXEL, SAMPLES) pixel_stored;

/* r, g, b, alpha in stored units. */
static inline float4 pixel_samples(pixel_stored p) {
#if SAMPLES > 2
    return convert_float4(p);
#else
    return convert_float2(p).xxxy;
#endif
}
#endif

/* What a board holds. With the flows u of the four neighbours, the data term's matrix J and right-hand side b, and
   weights s of smoothness, the linear system is
       (J11 + sum s) u1 + J12 u2 = b1 + sum s u1',    J12 u1 + (J22 + sum s) u2 = b2 + sum s u2'.
   Of the first and the last value no neighbour's is read, which might lie beside the array. */
enum board_value {
    BOARD_R1, BOARD_R2,                                             /* 1 / (J11 + sum s), 1 / (J22 + sum s) */
    BOARD_CROSS,                                                    /* J12 */
    BOARD_EAST, BOARD_SOUTH,                                        /* weights towards two neighbours, or 0 */
    BOARD_U, BOARD_V,                                               /* flow */
    BOARD_H, BOARD_HX, BOARD_HY, BOARD_VALID,                       /* feature */
    BOARD_WARPED_H, BOARD_WARPED_HX, BOARD_WARPED_HY, BOARD_WARPED, /* the other image's, by the flow */
    BOARD_J11, BOARD_J12, BOARD_J22, BOARD_J13, BOARD_J23,          /* constraints of a pixel alone */
    BOARD_B1, BOARD_B2,                                             /* b */
    BOARD_PLANES
};

/* A board holds values of a grid's pixels, parted by colour like the squares of a chequerboard: floats
   (2, grid.y, BOARD_PLANES, pitch), first the rows of pixels whose x + y is even, then the others, each with its
   pixels side by side, value for value. A pixel's neighbours lie side by side as well, in the other colour's rows,
   its diagonal ones in its own, so that compilers for CPUs can take many pixels of a row at a time; for that kernels
   over boards do not check columns. A row ends with at least one column of zeros, which is also what lies before
   the first column of the next. */
static inline int board_index(int x, int y, int4 grid, int pitch) {
    return (((x + y) & 1) * grid.y + y) * BOARD_PLANES * pitch + x / 2;
}

/* Put the sides of a pixel's system on a board (p: its first value). links: weights to the east, west, south and
   north. What nothing holds stays as it is. */
static inline void board_solve(__global float *p, int pitch, float3 data, float2 b, float4 links) {
    const float sum = links.x + links.y + links.z + links.w, first = data.x + sum, second = data.z + sum;
    p[BOARD_R1 * pitch] = 1.0f / (first > 0.0f ? first : 1.0f);
    p[BOARD_R2 * pitch] = 1.0f / (second > 0.0f ? second : 1.0f);
    p[BOARD_CROSS * pitch] = data.y;
    p[BOARD_EAST * pitch] = links.x;
    p[BOARD_SOUTH * pitch] = links.z;
    p[BOARD_B1 * pitch] = first > 0.0f ? b.x : p[BOARD_U * pitch];
    p[BOARD_B2 * pitch] = second > 0.0f ? b.y : p[BOARD_V * pitch];
}

/* The pixels of a grid that a cell of another one, over the same region, has: from column x and row y of the result up to
   column z and row w. */
static inline int4 cell_pixels(int column, int row, int4 grid, int4 cells) {
    return (int4)(column * grid.x / cells.x, row * grid.y / cells.y, (column + 1) * grid.x / cells.x,
                  (row + 1) * grid.y / cells.y);
}

/* Index of canvas pixel p in an array that covers box (left, top, width, height); -1 outside. */
static inline int box_index(int2 p, int4 box) {
    const int x = p.x - box.x, y = p.y - box.y;
    return x >= 0 && y >= 0 && x < box.z && y < box.w ? y * box.z + x : -1;
}

/* Longitudes and latitudes of a canvas grid: lonlat = (longitude of x = 0, radians per column, latitude of y = 0,
   radians per row); 0 radians per column mean a plane.

   A chart is the flat grid on which one pair's flow lives. Sphere: an equirectangular projection about an
   axis of its own; s0-2, s3-5, s6-8 are the rows of the rotation from the scene to the chart's axes.
   s9, sa: pixels per radian (sphere) or per canvas pixel (plane) in x, y; sb, sc: chart position of
   longitude 0, latitude 0 (sphere) or of the canvas's origin (plane); sd: 1 on the sphere;
   se: period of a wrapped plane in canvas pixels, else 0. Handed on by its address: compilers warn of
   float16 arguments of functions on a CPU without registers of that size.

   What follows is on spheres, for one point or several: the point of a canvas's or chart's position, and back. */
#define SPHERE(n)                                                                                                  \
    typedef struct {                                                                                               \
        float##n x, y, z;                                                                                          \
    } points##n;                                                                                                   \
    static inline points##n canvas_sphere##n(float##n x, float##n y, float4 lonlat) {                              \
        float##n cl, cp;                                                                                           \
        const float##n sl = angle_sincos##n(lonlat.x + x * lonlat.y, &cl);                                         \
        const float##n sp = angle_sincos##n(lonlat.z - y * lonlat.w, &cp);                                         \
        return (points##n){cp * sl, cp * cl, sp};                                                                  \
    }                                                                                                              \
    static inline float##n canvas_sphere_position##n(points##n q, float4 lonlat, float##n *y) {                    \
        *y = (lonlat.z - angle_of##n(q.z, root##n(q.x * q.x + q.y * q.y))) / lonlat.w;                             \
        return (angle_of##n(q.x, q.y) - lonlat.x) / lonlat.y;                                                      \
    }                                                                                                              \
    static inline points##n chart_sphere##n(float##n u, float##n v, const float16 *chart) {                        \
        float##n cl, cp;                                                                                           \
        const float##n sl = angle_sincos##n((u - chart->sb) / chart->s9, &cl);                                     \
        const float##n z = angle_sincos##n((chart->sc - v) / chart->sa, &cp), x = cp * sl, y = cp * cl;            \
        return (points##n){chart->s0 * x + chart->s3 * y + chart->s6 * z,                                          \
                           chart->s1 * x + chart->s4 * y + chart->s7 * z,                                          \
                           chart->s2 * x + chart->s5 * y + chart->s8 * z};                                         \
    }                                                                                                              \
    static inline float##n chart_sphere_position##n(points##n q, const float16 *chart, float##n *v) {              \
        const float##n x = chart->s0 * q.x + chart->s1 * q.y + chart->s2 * q.z;                                    \
        const float##n y = chart->s3 * q.x + chart->s4 * q.y + chart->s5 * q.z;                                    \
        const float##n z = chart->s6 * q.x + chart->s7 * q.y + chart->s8 * q.z;                                    \
        const float##n lon = angle_of##n(x, y), lat = angle_of##n(z, root##n(x * x + y * y));                      \
        *v = chart->sc - lat * chart->sa;                                                                          \
        return lon * chart->s9 + chart->sb;                                                                        \
    }
SPHERE()
SPHERE(4)

static inline float3 canvas_point(float2 p, float4 lonlat) {
    if (lonlat.y == 0.0f)
        return (float3)(p.x, p.y, 0.0f);
    const points q = canvas_sphere(p.x, p.y, lonlat);
    return (float3)(q.x, q.y, q.z);
}

/* The point of a chart's position. */
static inline float3 chart_point(float2 u, const float16 *chart) {
    if (chart->sd == 0.0f)
        return (float3)((u.x - chart->sb) / chart->s9, (u.y - chart->sc) / chart->sa, 0.0f);
    const points q = chart_sphere(u.x, u.y, chart);
    return (float3)(q.x, q.y, q.z);
}

static inline float2 canvas_position(float3 q, float4 lonlat) {
    if (lonlat.y == 0.0f)
        return q.xy;
    float y;
    const float x = canvas_sphere_position((points){q.x, q.y, q.z}, lonlat, &y);
    return (float2)(x, y);
}

static inline float2 chart_position(float3 q, const float16 *chart) {
    float2 u = (float2)(q.x * chart->s9 + chart->sb, q.y * chart->sa + chart->sc);
    if (chart->sd != 0.0f) {
        float v;
        u.x = chart_sphere_position((points){q.x, q.y, q.z}, chart, &v);
        u.y = v;
    } else if (chart->se > 0.0f) { /* the copy that lies on the chart, which may reach across the canvas's border */
        u.x -= floor_int(u.x / (chart->se * chart->s9)) * chart->se * chart->s9;
    }
    return u;
}

/* Where four positions of a chart lie on the canvas grid: x, and by its address y. */
static inline float4 chart_places(float4 u, float4 v, const float16 *chart, float4 lonlat, float4 *y) {
    if (lonlat.y == 0.0f) {
        *y = (v - chart->sc) / chart->sa;
        return (u - chart->sb) / chart->s9;
    }
    return canvas_sphere_position4(chart_sphere4(u, v, chart), lonlat, y);
}

/* Weights of the four pixels from `corner` on, to read between them at the fraction t, and their indices; weight
   and index 0 for those that do not lie on the grid. */
static inline float4 grid_taps(int2 corner, float2 t, int4 grid, int4 *at) {
    const float4 weights = (float4)(1.0f - t.x, t.x, 1.0f - t.x, t.x) * (float4)(1.0f - t.y, 1.0f - t.y, t.y, t.y);
    if (corner.x >= 0 && corner.y >= 0 && corner.x < grid.x - 1 && corner.y < grid.y - 1) {
        *at = corner.y * grid.x + corner.x + (int4)(0, 1, grid.x, grid.x + 1);
        return weights;
    }
    *at = (int4)(grid_index(corner, grid), grid_index(corner + (int2)(1, 0), grid),
                 grid_index(corner + (int2)(0, 1), grid), grid_index(corner + 1, grid));
    const int4 missing = *at < 0;
    *at = missing ? (int4)(0) : *at;
    return missing ? (float4)(0.0f) : weights;
}

/* The same at position q; weights sum to 1, or are all 0 where no pixel is. */
static inline float4 bilinear_taps(float2 q, int4 grid, int4 *at) {
    const int2 corner = floor_int2(q - 0.5f);
    const float4 weights = grid_taps(corner, q - 0.5f - convert_float2(corner), grid, at);
    const float sum = weights.x + weights.y + weights.z + weights.w;
    return weights * (sum > 1e-6f ? 1.0f / sum : 0.0f);
}

/* The whole turns in a way along what repeats after `period`: without them it is the shorter way around. 0: it does not
   repeat. */
static inline float whole_turns(float way, float period) {
    return period > 0.0f ? period * floor_int(way / period + 0.5f) : 0.0f;
}

/* The period of a canvas's columns: longitudes jump where they go once around. 0 on a plane, where positions go on. */
static inline float canvas_turn(float4 lonlat) {
    return lonlat.y != 0.0f ? 2.0f * M_PI_F / lonlat.y : 0.0f;
}

/* Pixels of another grid over the same region for each pixel of a grid. */
static inline float2 grid_ratio(int4 from, int4 to) {
    return (float2)((float)to.x / from.x, (float)to.y / from.y);
}

/* Where a pixel lies on another grid over the same region. */
static inline float2 grid_place(int x, int y, int4 from, int4 to) {
    return (float2)((x + 0.5f) * to.x / from.x, (y + 0.5f) * to.y / from.y);
}

/* Weights by which grids are halved, of the four pixels of a line around the two of which one is made: binomial, that is
   1, 3, 3 and 1 eighths. */
#define HALVING_TAPS {0.125f, 0.375f, 0.375f, 0.125f}

/* Bilinear reading of a grid at position q, over the taps that lie on it; 0 where none does. */
#define BILINEAR(name, type)                                                                                       \
    static inline type bilinear_##name(__global const type *values, float2 q, int4 grid) {                         \
        int4 at;                                                                                                   \
        const float4 w = bilinear_taps(q, grid, &at);                                                              \
        return w.x * values[at.x] + w.y * values[at.y] + w.z * values[at.z] + w.w * values[at.w];                  \
    }
BILINEAR(scalar, float)
BILINEAR(flow, float2)
BILINEAR(colour, float4)

#define EXCLUDED 1e3f /* brightness, in what consistency.cl makes, of pixels that do not count */

/* Bilinear mean of validity, 0 or 1, above which every tap that counts is valid: weights sum to 1 but for rounding. */
#define ALL_VALID 0.999f

/* A feature of flow.cl at pixel (x, y) displaced by f, bilinear; all 0 where a tap that counts is not valid. */
static inline float4 feature_sample(__global const float4 *feature, int x, int y, float2 f, int4 grid) {
    const int2 whole = floor_int2(f);
    int4 at;
    const float4 w = grid_taps((int2)(x, y) + whole, f - convert_float2(whole), grid, &at);
    const float4 sum = w.x * feature[at.x] + w.y * feature[at.y] + w.z * feature[at.z] + w.w * feature[at.w];
    return sum.w > ALL_VALID ? sum / sum.w : (float4)(0.0f);
}

/* A layer of the working grid at position q, bilinear; all 0 where a tap is missing. */
static inline float4 layer_sample(__global const float4 *layer, int4 box, float2 q, int4 border) {
    const int2 corner = floor_int2(q - 0.5f), first = corner - box.xy;
    const float2 t = q - 0.5f - convert_float2(corner);
    float4 sum = (float4)(0.0f);
    if (first.x >= 0 && first.y >= 0 && first.x + 1 < box.z && first.y + 1 < box.w) {
        /* nearly all samples: every tap is stored, no border rule is needed */
        __global const float4 *c = layer + first.y * box.z + first.x;
        const float4 upper = c[0] + t.x * (c[1] - c[0]), lower = c[box.z] + t.x * (c[box.z + 1] - c[box.z]);
        sum = upper + t.y * (lower - upper);
        return sum.w > ALL_VALID ? sum : (float4)(0.0f);
    }
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            int2 c = corner + (int2)(i, j);
            if (!grid_border(&c, border))
                continue;
            const int at = box_index(c, box);
            if (at >= 0)
                sum += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * layer[at];
        }
    return sum.w > ALL_VALID ? sum : (float4)(0.0f);
}

/* Where a layer is sampled for position q of the working grid. */
static inline float2 layer_position(float2 q, float3 d, float4 lonlat) {
    if (d.x == 0.0f && d.y == 0.0f && d.z == 0.0f)
        return q;
    return canvas_position(canvas_point(q, lonlat) + d, lonlat);
}

/* The same, at the end of the shorter way around: longitudes jump where they go once around. */
static inline float2 layer_near(float2 q, float3 d, float4 lonlat) {
    float2 there = layer_position(q, d, lonlat);
    there.x -= whole_turns(there.x - q.x, canvas_turn(lonlat));
    return there;
}

/* What an aligned layer shows for working pixel p; false where it shows nothing. */
static inline bool layer_shown(__global const float4 *layer, __global const float4 *field, int4 box, int2 p,
                               int4 border, float4 lonlat, float4 *c) {
    const int at = box_index(p, box);
    if (at < 0 || layer[at].w == 0.0f)
        return false;
    const float2 q = (float2)(p.x + 0.5f, p.y + 0.5f);
    *c = layer_sample(layer, box, layer_position(q, field[at].xyz, lonlat), border);
    return c->w != 0.0f;
}

/* What two aligned layers show for working pixel p; false where they do not both show something. */
static inline bool layer_pair(__global const float4 *layer_a, __global const float4 *field_a, int4 box_a,
                              __global const float4 *layer_b, __global const float4 *field_b, int4 box_b,
                              int2 p, int4 border, float4 lonlat, float4 *a, float4 *b) {
    return layer_shown(layer_a, field_a, box_a, p, border, lonlat, a) &&
           layer_shown(layer_b, field_b, box_b, p, border, lonlat, b);
}

/* The scale on which exposure differences are smooth fields, c in 0..1 of full scale: log odds of shoulder * c.
   Integer images: 1 where the camera's curve levels off towards white, less where it runs straight into it.
   Floats, which are coded by their roots: 0, which is log. The floor keeps dark noise, and what is nearly white, calm
   where differences are measured. */
#define EXPOSURE_FLOOR 0.02f

static inline float3 exposure_scale(float3 c, float shoulder) {
    const float3 low = GREATEST(c, (float3)(0.0f)) + EXPOSURE_FLOOR;
    const float3 odds = low / (GREATEST(1.0f - shoulder * c, (float3)(0.0f)) + EXPOSURE_FLOOR);
    return logarithm4(odds.xyzz).xyz;
}

/* The brightest channel of the darker one of two colours. */
static inline float darker_channel(float3 a, float3 b) {
    return LEAST(GREATEST(a.x, GREATEST(a.y, a.z)), GREATEST(b.x, GREATEST(b.y, b.z)));
}

/* Multiply these odds by 1 + rise, floats' roots by it themselves. Black stays, and an integer image is not raised
   beyond white; with a shoulder of 1 white stays as well. Exactly c where the rise is 0. */
#define EXPOSURE_RAISE(n)                                                                                          \
    static inline float##n exposure_raise##n(float##n c, float##n rise, float white, float shoulder) {             \
        const float##n low = shoulder * (c < white ? c : white);                                                   \
        const float##n v = c + c * rise * ((white - low) / (white + low * rise));                                  \
        return shoulder > 0.0f && v > white ? (c < white ? white : c) : v;                                         \
    }
EXPOSURE_RAISE(3)

/* Add a gain on the exposure scale. */
static inline float3 exposure_shift(float3 c, float3 gain, float shoulder) {
    return exposure_raise3(c, exponential4(gain.xyzz).xyz - 1.0f, 1.0f, shoulder);
}

/* A colour as a difference of it is seen. */
static inline float3 exposure_look(float3 c, float3 gain, float shoulder) {
    c = exposure_shift(c, gain, shoulder);
    return GREATEST(c, (float3)(0.0f));
}

/* Where a grid of gains, which are smooth, has that of a cell's centre. */
static inline int gain_index(int column, int row, int4 cells, int4 colours) {
    return (2 * row + 1) * colours.y / (2 * cells.y) * colours.x + (2 * column + 1) * colours.x / (2 * cells.x);
}

/* Weights of the four taps around fraction t by cubic convolution (Keys, "Cubic convolution interpolation for
   digital image processing", 1981): exactly (0, 1, 0, 0) at t = 0. a: slope at the kernel's first zero. */
static inline float4 cubic_taps(float t, float a) {
    const float4 third = (float4)(a, a + 2.0f, -a - 2.0f, -a);
    const float4 second = (float4)(-2.0f * a, -a - 3.0f, 2.0f * a + 3.0f, a);
    return (float4)(0.0f, 1.0f, 0.0f, 0.0f) + t * ((float4)(a, 0.0f, -a, 0.0f) + t * (second + t * third));
}
