/* Where one layer is taken whole. */

/* Whether a sample a tells how much it differs from b though it may be clipped: b is darker, by more than `darker`,
   than what just clips in a would be in b's layer. gain: a's less b's, on the exposure scale; by how much exposures differ
   what both would show of a grey tells: towards white some cameras' curves level off, and bring them closer. */
static inline int seam_tells(float3 a, float3 clipped, float3 b, float3 gain, float shoulder, float darker) {
    const float3 ratio = 2.0f * exposure_shift((float3)(0.5f), gain, shoulder);
    const float3 darkest = LEAST(ratio, (float3)(1.0f)) * clipped - darker;
    return all(a <= clipped || b < darkest);
}

/* Mean difference a - b of two aligned, corrected layers over the pixels of a cell (every second one in x and y)
   that both show, where neither clips or the other is darker for certain, the share of these, the mean square of the
   channel that differs most, and what tells of their textures, means of the channels: the variance of what each shows;
   and of the means of blocks of up to four such pixels, in which noise is less, the variances and their covariance. */
__kernel void seam_difference(__global const float4 *layer_a, __global const float4 *field_a, int4 box_a,
                              __global const float4 *gain_a, /* (colours.y, colours.x) */
                              __global const float4 *layer_b, __global const float4 *field_b, int4 box_b,
                              __global const float4 *gain_b, /* (colours.y, colours.x) */
                              int4 border, float4 lonlat,  /* working grid */
                              int4 colours, int4 cells,    /* grid of the gains; seam grid */
                              int4 part,                   /* cells that are compared, run size */
                              float shoulder,              /* of the exposure scale */
                              float4 clipped_a, float4 clipped_b, /* brighter samples may be clipped */
                              float darker, /* they tell if the other is darker by so much than they can be */
                              __global float4 *difference, /* (part.w, part.z): r, g, b, share */
                              __global float *square,      /* (part.w, part.z) */
                              __global float8 *texture)    /* the same: variances, of blocks, their covariance, 0 */
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= part.z || row >= part.w)
        return;
    const int cx = part.x + column, cy = part.y + row;
    const int4 its = cell_pixels(cx, cy, border, cells);
    const int g = gain_index(cx, cy, cells, colours);
    const float3 brighter = gain_a[g].xyz - gain_b[g].xyz;
    float3 sum = (float3)(0.0f), squares = sum, sum_a = sum, sum_b = sum, squares_a = sum, squares_b = sum;
    float3 mean_a = sum, mean_b = sum, means_a = sum, means_b = sum, products = sum;
    float n = 0.0f, tried = 0.0f, blocks = 0.0f;
    for (int top = its.y; top < its.w; top += 4)
        for (int left = its.x; left < its.z; left += 4) {
            float3 block_a = (float3)(0.0f), block_b = block_a;
            float count = 0.0f;
            for (int y = top; y < top + 4 && y < its.w; y += 2)
                for (int x = left; x < left + 4 && x < its.z; x += 2) {
                    tried += 1.0f;
                    float4 a, b;
                    const int2 p = (int2)(x, y);
                    if (!layer_pair(layer_a, field_a, box_a, layer_b, field_b, box_b, p, border, lonlat, &a, &b) ||
                        !seam_tells(a.xyz, clipped_a.xyz, b.xyz, brighter, shoulder, darker) ||
                        !seam_tells(b.xyz, clipped_b.xyz, a.xyz, -brighter, shoulder, darker))
                        continue;
                    const float3 look_a = exposure_look(a.xyz, gain_a[g].xyz, shoulder);
                    const float3 look_b = exposure_look(b.xyz, gain_b[g].xyz, shoulder), d = look_a - look_b;
                    sum += d;
                    squares += d * d;
                    block_a += look_a;
                    block_b += look_b;
                    squares_a += look_a * look_a;
                    squares_b += look_b * look_b;
                    count += 1.0f;
                }
            if (count == 0.0f)
                continue;
            sum_a += block_a;
            sum_b += block_b;
            n += count;
            block_a /= count;
            block_b /= count;
            mean_a += block_a;
            mean_b += block_b;
            means_a += block_a * block_a;
            means_b += block_b * block_b;
            products += block_a * block_b;
            blocks += 1.0f;
        }
    const int at = row * part.z + column;
    difference[at] = n > 0.0f ? (float4)(sum / n, n / tried) : (float4)(0.0f);
    square[at] = n > 0.0f ? GREATEST(squares.x, GREATEST(squares.y, squares.z)) / n : 0.0f;
    const float count = GREATEST(n, 1.0f), some = GREATEST(blocks, 1.0f);
    const float3 spread_a = squares_a - sum_a * sum_a / count, spread_b = squares_b - sum_b * sum_b / count;
    const float3 coarse_a = means_a - mean_a * mean_a / some, coarse_b = means_b - mean_b * mean_b / some;
    const float3 common = products - mean_a * mean_b / some;
    const float3 each = 1.0f / (3.0f * count), of_blocks = 1.0f / (3.0f * some);
    texture[at] = (float8)(dot(spread_a, each), dot(spread_b, each), dot(coarse_a, of_blocks), dot(coarse_b, of_blocks),
                           dot(common, of_blocks), 0.0f, 0.0f, 0.0f);
}

/* The least weight that is told from none, about exp(-87). */
#define SEAM_LEAST 1.7e-38f

/* Take a layer's colour weight away where it yields, but for a trace, and let layers weigh the same before where they
   are cut: a cut is where it was chosen, however much more one of them weighed. Both bilinear from the seam grid. */
__kernel void seam_yield(__global float4 *field,        /* (box.w, box.z) of the working grid; w changes */
                         int4 box, int4 border,         /* place on the working grid, run size; working grid */
                         __global const float *yields,  /* (cells.y, cells.x), 0..1 */
                         __global const float *same,    /* (cells.y, cells.x), 0..1: weights to the power 1 - same */
                         int4 cells,                    /* seam grid, over the same region */
                         float trace)                   /* the least that is left, of the weight */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w || !(field[at].w > 0.0f))
        return;
    const float2 place = (float2)(x + box.x + 0.5f, y + box.y + 0.5f) * grid_ratio(border, cells);
    const float keep = 1.0f - bilinear_scalar(yields, place, cells), power = 1.0f - bilinear_scalar(same, place, cells);
    /* to the fourth power: the softmax's own weights span many powers of ten */
    const float left = keep * keep * keep * keep;
    if (power < 1.0f)
        field[at].w = exponential(power * logarithm(GREATEST(field[at].w, SEAM_LEAST)));
    if (left < 1.0f)
        field[at].w *= GREATEST(left, trace);
}

/* A layer's colour weight at the centres of cells; 0 where the layer is not. */
__kernel void seam_weights(__global const float4 *field, /* (box.w, box.z) */
                           int4 box,                     /* place on the working grid */
                           __global const int *rows,     /* (cells.y) of the working grid, in which centres lie */
                           __global const int *columns,  /* (cells.x) */
                           int4 cells,                   /* run size */
                           __global float *weights)      /* (cells.y, cells.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cells.x || y >= cells.y)
        return;
    const int at = box_index((int2)(columns[x], rows[y]), box);
    weights[y * cells.x + x] = at < 0 ? 0.0f : field[at].w;
}

/* Px of the working grid by which a layer may be sampled beyond its border: clamped to that, it smears nothing. */
#define SEAM_BEYOND 0.5f

/* Whether a layer shows something wherever it is sampled for a cell: for every second pixel in x and y that it covers.
   Of a cell that it does not cover that says nothing. */
__kernel void seam_shown(__global const float4 *layer, /* (box.w, box.z) */
                         __global const float4 *field, /* the same */
                         int4 box, int4 border,        /* place on the working grid; working grid */
                         float4 lonlat,
                         int4 cells,                   /* seam grid, over the same region; run size */
                         __global uchar *shown)        /* (cells.y, cells.x): 0 or 1 */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    const int4 its = cell_pixels(cx, cy, border, cells);
    bool all_of_it = true;
    for (int y = its.y; y < its.w && all_of_it; y += 2)
        for (int x = its.x; x < its.z; x += 2) {
            const int at = box_index((int2)(x, y), box);
            if (at < 0 || layer[at].w == 0.0f)
                continue;
            const float2 q = (float2)(x + 0.5f, y + 0.5f);
            const float3 d = field[at].xyz;
            const float length = ROOT(square2(layer_near(q, d, lonlat) - q));
            const float part = length > SEAM_BEYOND ? 1.0f - SEAM_BEYOND / length : 0.0f;
            all_of_it = all_of_it && layer_sample(layer, box, layer_position(q, part * d, lonlat), border).w != 0.0f;
        }
    shown[cy * cells.x + cx] = all_of_it;
}

/* Halvings in which it is found how far a displacement leads to what a layer shows. */
#define SEAM_HALVINGS 5

/* Clamp displacements of what is taken from a layer to where the layer shows something. */
__kernel void seam_clamp(__global const float4 *layer, /* (box.w, box.z) */
                         __global float4 *field,       /* the same; x, y, z change */
                         int4 box, int4 border,        /* place on the working grid, run size; working grid */
                         float4 lonlat,
                         __global const uchar *taken,  /* (cells.y, cells.x): the cells of what is taken from it */
                         int4 cells)                   /* seam grid, over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w || layer[at].w == 0.0f)
        return;
    const float2 q = (float2)(x + box.x + 0.5f, y + box.y + 0.5f);
    const int2 cell = convert_int2(q * grid_ratio(border, cells));
    if (!taken[min(cell.y, cells.y - 1) * cells.x + min(cell.x, cells.x - 1)])
        return;
    const float4 own = field[at];
    float3 d = own.xyz;
    if (layer_sample(layer, box, layer_position(q, d, lonlat), border).w == 0.0f) {
        float part = 0.0f, step = 0.5f;
        for (int i = 0; i < SEAM_HALVINGS; ++i, step *= 0.5f)
            if (layer_sample(layer, box, layer_position(q, (part + step) * d, lonlat), border).w != 0.0f)
                part += step;
        d *= part;
    }
    field[at] = (float4)(d, own.w);
}
