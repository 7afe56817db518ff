/* The full-resolution pass over one band of rows. Built with PIXEL (stored sample type), SAMPLES (2 or 4, alpha
   last), WHITE (full scale), INTEGER (1: round and saturate), PIXELS (2 or 4, that a work item makes side by side)
   and BLOCK (pixels, a multiple of PIXELS). Places are pixels of the region. */

/* Where r, g or b is not 0. */
static inline blend_int blend_any(blend_samples v) {
    const blend_marks set = v != 0.0f;
    return set.REDS | set.GREENS | set.BLUES;
}

/* Columns in an array of those from span.x on, span.y of them; beyond it, its rim. */
static inline blend_between blend_within(blend_between at, int2 span, int4 border) {
    blend_int left = at.left - span.x, right = at.right - span.x; /* Mesa 22 would change the caller's at */
    if (border.z && span.y == border.x) {
        left += left < 0 ? border.x : 0;
        right -= right >= border.x ? border.x : 0;
    }
    return (blend_between){LIMITED(left, 0, span.y - 1), LIMITED(right, 0, span.y - 1), at.t};
}

/* Which rows of a coarse array a line of pixels lies between, and how far. */
typedef struct {
    __global const float4 *upper, *lower;
    float t;
} blend_lines;

/* Those beside height q of the grid. place: of the array, whose values begin at `values`; beyond it, its rim. */
static inline blend_lines blend_beside(__global const float4 *values, int4 place, float q) {
    const int row = floor_int(q - 0.5f), first = row - place.y, last = place.w - 1;
    return (blend_lines){values + LIMITED(first, 0, last) * place.z, values + LIMITED(first + 1, 0, last) * place.z,
                         q - 0.5f - row};
}

/* Bilinear reading. */
static inline blend_samples blend_read(blend_lines lines, blend_between at) {
#define BLEND_UPPER_LEFT(n, i) lines.upper[at.left.i]
#define BLEND_UPPER_RIGHT(n, i) lines.upper[at.right.i]
#define BLEND_LOWER_LEFT(n, i) lines.lower[at.left.i]
#define BLEND_LOWER_RIGHT(n, i) lines.lower[at.right.i]
    blend_samples left = (blend_samples)(BLEND_LIST(BLEND_UPPER_LEFT));
    blend_samples right = (blend_samples)(BLEND_LIST(BLEND_UPPER_RIGHT));
    left += lines.t * ((blend_samples)(BLEND_LIST(BLEND_LOWER_LEFT)) - left);
    right += lines.t * ((blend_samples)(BLEND_LIST(BLEND_LOWER_RIGHT)) - right);
    return left + BLEND_EACH(at.t) * (right - left);
}

/* How pixels are corrected: what odds are multiplied by, less 1, then what is added, for floats to the
   logarithms of exposure_scale, of their roots; where there is something. */
typedef struct {
    blend_samples rise, offset;
    blend_int some;
} blend_correction;

/* Where their corrections are read: arrays; columns and heights of the grids. */
typedef struct {
    __global const float4 *gains, *offsets;
    blend_between gain_column, offset_column;
    float gain_height, offset_height;
    int4 offset_border;
} blend_corrections;

BLEND_INLINE blend_correction blend_corrected(const blend_corrections *from, __global const blend_layer *layer) {
    blend_correction result = {(blend_samples)(0.0f), (blend_samples)(0.0f), (blend_int)(0)};
    if (layer->gains >= 0) {
        const blend_lines lines = blend_beside(from->gains + layer->gains, layer->gain, from->gain_height);
        const blend_samples gain = blend_read(lines, from->gain_column);
        result.rise = BLEND_EXPONENTIAL(gain) - 1.0f;
        result.some = blend_any(gain);
    }
    if (layer->offsets >= 0) {
        const blend_between column = blend_within(from->offset_column, layer->offset.xz, from->offset_border);
        const blend_lines lines = blend_beside(from->offsets + layer->offsets, layer->offset, from->offset_height);
        const blend_samples offset = blend_read(lines, column);
        result.offset = INTEGER ? WHITE * offset : BLEND_EXPONENTIAL(offset) - 1.0f;
        result.some |= blend_any(offset);
    }
    return result;
}

/* Floats are corrected as they are coded at working resolution, by their roots (unit.cl). */
static inline blend_samples blend_correct(blend_samples c, blend_correction by, float shoulder, float unit_root) {
    if (INTEGER)
        return BLEND_RAISE(c, by.rise, WHITE, shoulder) + by.offset;
    const blend_samples light = GREATEST(c, (blend_samples)(0.0f));
#define BLEND_0 s0123 /* the samples of each pixel */
#define BLEND_1 s4567
#define BLEND_2 s89ab
#define BLEND_3 scdef
#define BLEND_LIGHT(n, i) root4(light.BLEND_##n)
    blend_samples v = (blend_samples)(BLEND_LIST(BLEND_LIGHT));
    v += v * by.rise;
    v += (v + EXPOSURE_FLOOR * unit_root) * by.offset;
    v = GREATEST(v, (blend_samples)(0.0f));
    return c < 0.0f || (by.rise == 0.0f && by.offset == 0.0f) ? c : v * v;
}

/* atan2: a few terms of the series do where x is positive and the angle small, as it nearly always is. */
static inline blend_real blend_angles(blend_real y, blend_real x) {
    const blend_real t = y / x, t2 = t * t;
    const blend_int small = x > 0.0f && t2 < 0.01f;
    const blend_real angle = t * (1.0f - t2 * (1.0f / 3.0f - t2 * (0.2f - t2 * (1.0f / 7.0f))));
    return BLEND_SOME(!small) ? (small ? angle : atan2(y, x)) : angle;
}

/* Where a layer is sampled for pixels at (px, py): the field's displacements d carried to full resolution.
   sl, cl, sp, cp: sine and cosine of the pixels' longitudes and latitude. */
static inline void blend_positions(blend_real px, float py, blend_samples d, float2 scale, float4 lonlat, blend_real sl,
                                   blend_real cl, float sp, float cp, blend_real *x, blend_real *y) {
    const blend_real dx = d.REDS, dy = d.GREENS, dz = d.BLUES;
    if (lonlat.y == 0.0f) {
        *x = px + dx * scale.x;
        *y = py + dy * scale.y;
        return;
    }
    /* in the frame of p (east, north, up) the change of longitude is small, hence exact in float32 */
    const blend_real east = cl * dx - sl * dy, out = cp + sl * dx + cl * dy;
    const blend_real north = sp + dz, squared = east * east + out * out;
#define BLEND_ROOT(n, i) ROOT(squared.i)
    const blend_real level = (blend_real)(BLEND_LIST(BLEND_ROOT));
    *x = px + blend_angles(east, out) / lonlat.y;
    *y = py - blend_angles(north * cp - level * sp, level * cp + north * sp) / lonlat.w;
}

/* The fractions above which r, g, b are rounded up at canvas pixels from (x, y) on: uniform in 0..1, so that
   the mean of many rounded pixels is right. Steps of the golden ratio spread them evenly along a row, which halves
   the noise that is coarse enough to be seen; where rows begin is mixed from all bits of y and channel. */
static inline blend_samples blend_thresholds(int x, int y) {
    uint4 h = (uint)y * 4u + (uint4)(0, 1, 2, 3);
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    h ^= h >> 16;
    typedef PIXEL_VECTOR(uint, BLEND_SAMPLES) blend_bits;
#define BLEND_COLUMN(n, i) (uint4)(x + n)
#define BLEND_SAME(n, i) h
    const blend_bits same = (blend_bits)(BLEND_LIST(BLEND_SAME));
    const blend_bits across = (blend_bits)(BLEND_LIST(BLEND_COLUMN)) * 0x9e3779b9u;
    return (BLEND_FLOATS((same + across) >> 16) + 0.5f) / 65536.0f;
}

/* Whole numbers from 0 to full scale, rounded to nearest, or by dither where a threshold says so. What is whole
   but for the rounding of float32 stays as it is. */
static inline blend_samples blend_round(blend_samples v, blend_samples thresholds, blend_marks dithered) {
    v = v < 0.0f ? 0.0f : v > WHITE ? WHITE : v;
    const blend_samples nearest = (v + 8388608.0f) - 8388608.0f, off = v - nearest; /* 2^23 leaves no bits below 1 */
    const blend_samples below = BLEND_FLOATS(PIXEL_VECTOR(convert_, PIXEL_VECTOR(int, BLEND_SAMPLES))(v));
    const blend_samples spread = v - below > thresholds ? below + 1.0f : below;
    return dithered ? (off <= 2e-7f * WHITE && off >= -2e-7f * WHITE ? nearest : spread) : nearest;
}

/* The number of a block of the band, by a place in it. */
static inline int blend_block(int x, int y, int4 band) {
    return y * ((band.z + BLOCK - 1) / BLOCK) + x / BLOCK;
}

/* The first layer from k on that is marked; count: none is. */
static inline int blend_next(__global const uint *marks, int k, int count) {
    for (; k < count; ++k) {
        const uint rest = marks[k >> 5] >> (k & 31);
        if (rest & 1u)
            return k;
        k |= rest ? 0 : 31; /* none is left in this word: on to the next */
    }
    return count;
}

/* Whether one of `width` pixels from p on to the right is valid. */
static inline int blend_shows(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p,
                              int width) {
    const int4 place = layer->place;
    const int y = p.y - place.y, left = GREATEST(p.x - place.x, 0), right = LEAST(p.x - place.x + width, place.z);
    if (y < 0 || y >= place.w)
        return 0;
    __global const pixel_stored *line = blend_line(stored, layer, y);
    for (int x = left; x < right; ++x)
        if (line[x].BLEND_ALPHA >= BLEND_VALID)
            return 1;
    return 0;
}

/* Whether a weight that is read between the columns of a first pixel, as x, and of a last one, as y, may be more than
   0. All round a canvas, or across its border, is not looked at: it may. */
static inline int blend_weighs(blend_lines lines, blend_between columns, int2 span, int4 border) {
    const blend_between at = blend_within(columns, span, border);
    const int first = at.left.x, last = at.right.y;
    int some = columns.right.y - columns.left.x >= border.x || last < first;
    for (int x = first; x <= last; ++x)
        some |= lines.upper[x].w > 0.0f || lines.lower[x].w > 0.0f;
    return some;
}

/* Which layers a row's blocks of BLOCK pixels show, and which of these may weigh something there: most layers that a
   band touches are nowhere near, and mostly one alone is left. Bit k % 32 of word k / 32 is layer k's. */
__kernel void blend_mark(
    __global const pixel_stored *stored, __global const blend_layer *layers, int count, /* as blend_band has them */
    __global const float4 *fields, int4 border, int4 field_border,                      /* so are these */
    int4 band,             /* its place: left, top, width, height; run size: blocks, rows */
    int words,             /* for a bit of each layer */
    __global uint *marks)  /* (band.w, blocks, 2, words): shown, weighing */
{
    const int x = BLOCK * get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int2 place = (int2)(x + band.x, y + band.y);
    const int width = LEAST(BLOCK, band.z - x);
    blend_real ends = (blend_real)(place.x + width - 0.5f); /* the last pixel's, and as x the first one's */
    ends.x = place.x + 0.5f;
    const float2 scale = grid_ratio(field_border, border);
    const blend_between columns = blend_split(ends / scale.x);
    const float row = (place.y + 0.5f) / scale.y;
    __global uint *shown = marks + 2 * words * blend_block(x, y, band);
    for (int word = 0; word < words; ++word) {
        uint seen = 0, weighing = 0;
        for (int k = 32 * word; k < LEAST(32 * word + 32, count); ++k) {
            if (!blend_shows(stored, layers + k, place, width))
                continue;
            seen |= 1u << (k & 31);
            const blend_lines beside = blend_beside(fields + layers[k].fields, layers[k].field, row);
            if (blend_weighs(beside, columns, layers[k].field.xz, field_border))
                weighing |= 1u << (k & 31);
        }
        shown[word] = seen;
        shown[words + word] = weighing;
    }
}

/* One band of the panorama: each pixel is the mean of the layers that cover it, sampled where their fields say and
   weighted as they say. The sum is of differences from the first of these samples, so that equal colours stay equal
   to the bit. Where only one covers it (but for thin strips), or none weighs anything, a pixel is the first layer's own. */
__kernel void blend_band(
    __global const pixel_stored *stored, /* a ring of rows for each layer: (ring, width) */
    __global const blend_layer *layers, int count, /* those that the band may touch */
    __global const float4 *fields,       /* per layer, (field.w, field.z): displacement, weight, from hidden_mark */
    __global const float4 *gains,        /* per corrected layer, (gain.w, gain.z), whole rows of their grid */
    __global const float4 *offsets,      /* per layer with offsets, (offset.w, offset.z) */
    __global const float2 *columns,      /* (band.z) sine and cosine of longitude; plane: not used */
    __global const float2 *lines,        /* (band.w) sine and cosine of latitude; plane: not used */
    int4 border, float4 lonlat,          /* full-resolution grid of the region */
    int4 field_border, int4 gain_border, int4 offset_border, /* working grid; colour grid; grid of offsets */
    int4 band,                           /* its place: left, top, width, height; run size: columns / PIXELS, rows */
    int2 origin,                         /* the region's place on the canvas */
    float shoulder,                      /* of the exposure scale */
    float unit_root,                     /* of the floats' value that counts as full scale of their code */
    int nearest,                         /* 1: nearest-neighbour sampling */
    float share,                         /* of all weight, below which a layer is hidden */
    __global const uint *marks, int words, /* from blend_mark */
    __global const uchar *carried,       /* (strips.y, strips.x) where one layer alone is sampled so as well */
    int4 strips,                         /* a grid over the region; zeros: nowhere */
    __global pixel_stored *out)          /* (band.w, band.z) */
{
    const int x = PIXELS * get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int2 place = (int2)(x + band.x, y + band.y);
    const blend_real px = BLEND_REALS(place.x + BLEND_COUNT) + 0.5f;
    const float py = place.y + 0.5f;
    const float2 scale = grid_ratio(field_border, border), gain_scale = grid_ratio(border, gain_border);
    const float2 offset_scale = grid_ratio(border, offset_border);
    const blend_corrections corrections = {
        gains, offsets, blend_within(blend_split(px * gain_scale.x), (int2)(0, gain_border.x), gain_border),
        blend_split(px * offset_scale.x), py * gain_scale.y, py * offset_scale.y, offset_border};

    /* which pixels any layer covers, and which several do */
    __global const uint *shown = marks + 2 * words * blend_block(x, y, band);
    blend_int known = (blend_int)(0), several = (blend_int)(0);
    for (int k = -1; BLEND_SOME(!several) && (k = blend_next(shown, k + 1, count)) < count;) {
        const blend_int seen = blend_valid(stored, layers + k, place);
        several |= seen & known;
        known |= seen;
    }
    if (strips.x) {
        __global const uchar *line = carried + LEAST((int)(py * strips.y / border.y), strips.y - 1) * strips.x;
#define BLEND_STRIP(n, i) (line[LEAST((int)(px.i * strips.x / border.x), strips.x - 1)] ? -1 : 0)
        several |= known & (blend_int)(BLEND_LIST(BLEND_STRIP));
    }
    blend_int corrected = (blend_int)(0);
    blend_samples reference = (blend_samples)(0.0f), sum = reference;
    if (BLEND_SOME(several)) {
        const blend_between column = blend_split(px / scale.x);
        blend_real sl = (blend_real)(0.0f), cl = sl;
        float sp = 0.0f, cp = 0.0f;
        if (lonlat.y != 0.0f) {
            const int last = band.z - 1;
#define BLEND_SINE(n, i) columns[LEAST(x + n, last)].x
#define BLEND_COSINE(n, i) columns[LEAST(x + n, last)].y
            sl = (blend_real)(BLEND_LIST(BLEND_SINE));
            cl = (blend_real)(BLEND_LIST(BLEND_COSINE));
            sp = lines[y].x;
            cp = lines[y].y;
        }
        blend_real hidden = (blend_real)(0.0f);
        blend_int open = several;
        /* a second time with all layers, if most of what is seen lies outside its layer */
        for (int round = 0; round < 2 && BLEND_SOME(open); ++round) {
            blend_real total = (blend_real)(0.0f);
            blend_samples all = (blend_samples)(0.0f), start = all;
            __global const uint *marked = round ? shown : shown + words;
            for (int k = -1; (k = blend_next(marked, k + 1, count)) < count;) {
                blend_samples c = blend_taps(stored, layers + k, place);
                blend_int seen = open & (c.FOURTHS != 0.0f);
                if (!BLEND_SOME(seen))
                    continue;
                const int4 span = layers[k].field;
                const blend_lines beside = blend_beside(fields + layers[k].fields, span, py / scale.y);
                const blend_samples field = blend_read(beside, blend_within(column, span.xz, field_border));
                blend_real w = field.FOURTHS + hidden;
                seen &= w > 0.0f;
                if (!BLEND_SOME(seen))
                    continue;
                w = seen ? w : 0.0f;
                total += w;
                const blend_int moved = seen & blend_any(field);
                if (BLEND_SOME(moved)) {
                    blend_real qx, qy;
                    blend_positions(px, py, field, scale, lonlat, sl, cl, sp, cp, &qx, &qy);
                    blend_sample_all(stored, layers + k, qx, qy, moved, border, nearest, &c);
                }
                /* a sample that falls outside its layer counts smoothly less */
                w *= c.FOURTHS * c.FOURTHS;
                const blend_correction correction = blend_corrected(&corrections, layers + k);
                c = blend_correct(c, correction, shoulder, unit_root);
                corrected |= correction.some & (w > 0.0f);
                start = BLEND_EACH(all.FOURTHS == 0.0f) ? c : start; /* the next, if that weighs nothing */
                blend_samples part = (c - start) * BLEND_EACH(w);
                part.FOURTHS = w;
                all += part;
            }
            sum = BLEND_EACH(open) ? all : sum;
            reference = BLEND_EACH(open) ? start : reference;
            open &= !(all.FOURTHS >= 0.5f * total);
            hidden = share * total;
        }
    }
    const blend_int mixed = sum.FOURTHS > 1e-30f;
    blend_samples v = reference + sum / BLEND_EACH(mixed ? sum.FOURTHS : 1.0f);
    blend_int alone = known & !mixed;
    for (int k = -1; BLEND_SOME(alone) && (k = blend_next(shown, k + 1, count)) < count;) {
        const blend_samples own = blend_taps(stored, layers + k, place);
        const blend_int fresh = alone & (own.FOURTHS != 0.0f);
        if (!BLEND_SOME(fresh))
            continue;
        const blend_correction correction = blend_corrected(&corrections, layers + k);
        v = BLEND_EACH(fresh) ? blend_correct(own, correction, shoulder, unit_root) : v;
        corrected |= fresh & correction.some;
        alone &= !fresh;
    }
    v.FOURTHS = known ? (blend_real)(WHITE) : (blend_real)(0.0f);
    if (INTEGER)
        v = blend_round(v, blend_thresholds(place.x + origin.x, place.y + origin.y), BLEND_EACH(corrected));
    const blend_pixels made = blend_stored(v);
    __global pixel_stored *target = out + y * band.z + x;
    for (int n = 0; n < PIXELS && x + n < band.z; ++n)
        target[n] = ((const pixel_stored *)&made)[n];
}
