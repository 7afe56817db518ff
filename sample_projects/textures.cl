// Procedural textures of the sample room. Each takes a place in metres and `footprint`, a pixel's size there in
// metres, and leaves out what is finer: nothing aliases, and every view sees the same surface.

#define PI 3.14159265f

// Offsets into a primitive's PRIM_STRIDE floats; written by tracer.py under the same names.
#define PRIM_STRIDE 48
#define PRIM_INVERSE 0    // 12: world to unit space, three rows of (x, y, z, offset)
#define PRIM_FORWARD 12   // 12: unit space to world
#define PRIM_HALF 24      // 3: half extents in metres; textures are in metres
#define PRIM_SHAPE 27
#define PRIM_TAPER 28
#define PRIM_MATERIAL 29
#define PRIM_COLOUR 30    // 3: linear RGB
#define PRIM_SECOND 33    // 3: a second colour for patterns
#define PRIM_SEED 36
#define PRIM_TEXEL 37     // index of the first texel of its light map
#define PRIM_COUNTS 38    // 3: texels along local x, y, z (box); around, along, across (round shapes)

// ---------------------------------------------------------------------------------------------- noise

static uint hash3(int x, int y, uint seed) {
    uint h = (uint)x * 0x8da6b343u ^ (uint)y * 0xd8163841u ^ seed * 0xcb1ab31fu;
    h ^= h >> 15; h *= 0x2c1b3c6du; h ^= h >> 12; h *= 0x297a2d39u; h ^= h >> 15;
    return h;
}

static float random3(int x, int y, uint seed) { return (float)(hash3(x, y, seed) >> 8) * (1.0f / 16777216.0f); }

static float value_noise(float2 p, uint seed) {
    float2 cell = floor(p), f = p - cell;
    int x = (int)cell.x, y = (int)cell.y;
    f = f * f * f * (f * (f * 6.0f - 15.0f) + 10.0f);
    float low = mix(random3(x, y, seed), random3(x + 1, y, seed), f.x);
    float high = mix(random3(x, y + 1, seed), random3(x + 1, y + 1, seed), f.x);
    return mix(low, high, f.y) * 2.0f - 1.0f;
}

// Sum of octaves from `wavelength` downwards, each faded out before `footprint` could alias it.
static float octaves(float2 p, float wavelength, int count, float footprint, uint seed) {
    float sum = 0.0f, weight = 0.5f;
    for (int i = 0; i < count; i++) {
        float fade = clamp(wavelength / footprint * 0.5f - 0.6f, 0.0f, 1.0f);
        if (fade <= 0.0f) break;
        sum += weight * fade * value_noise(p / wavelength, seed + 7u * i);
        weight *= 0.6f; wavelength *= 0.5f;
    }
    return sum;
}

// 1 inside (signed distance < 0), 0 outside, with an edge one footprint wide.
static float inside(float distance, float footprint) {
    return clamp(0.5f - distance / fmax(footprint, 1e-4f), 0.0f, 1.0f);
}

// Distance from x to the middle of the nearest line of a grid with that period.
static float to_line(float x, float period) { return fabs(x - period * round(x / period)); }

// ------------------------------------------------------------------------------------------- textures

static float3 wood(float2 p, float3 colour, float footprint, uint seed) {
    float bend = octaves((float2)(p.x * 0.25f, p.y), 0.11f, 3, footprint, seed);
    float rings = sin((p.y + 0.035f * bend) * 160.0f) * clamp(0.014f / footprint - 0.5f, 0.0f, 1.0f);
    float fibre = octaves((float2)(p.x * 0.07f, p.y), 0.012f, 3, footprint, seed + 91u);
    return colour * (1.0f + 0.30f * bend + 0.09f * rings + 0.30f * fibre);
}

static float3 parquet(float2 p, float3 colour, float footprint, uint seed) {
    const float wide = 0.125f, plank = 1.1f;
    float row = floor(p.y / wide);
    float along = p.x + plank * random3((int)row, 3, seed);
    float column = floor(along / plank);
    float tone = random3((int)row, (int)column, seed + 1u);
    float3 base = colour * (0.78f + 0.40f * tone) * (float3)(1.0f, 1.0f - 0.05f * tone, 1.0f - 0.12f * tone);
    base = wood((float2)(p.x, p.y + 3.1f * tone), base, footprint, seed + 13u * (uint)(tone * 255.0f));
    float gap = fmax(inside(to_line(p.y, wide) - 0.0016f, footprint) * fmin(1.0f, 0.0032f / footprint),
                     inside(to_line(along, plank) - 0.0016f, footprint) * fmin(1.0f, 0.0032f / footprint));
    return base * (1.0f - 0.75f * gap);
}

static float3 wallpaper(float2 p, float3 colour, float3 second, float footprint, uint seed) {
    const float pitch = 0.24f;
    float row = floor(p.y / pitch);
    float2 q = (float2)(p.x + 0.5f * pitch * ((int)row & 1), p.y);
    float2 cell = floor(q / pitch);
    float2 c = q - (cell + 0.5f) * pitch;
    // a blossom with five petals, on a bent stem with two leaves
    float2 head = c - (float2)(0.0f, 0.035f);
    float reach = length(head), turn = atan2(head.y, head.x);
    float petals = inside(reach - 0.030f * (0.72f + 0.28f * cos(5.0f * turn)), footprint);
    petals *= 1.0f - inside(reach - 0.008f, footprint);
    float bend = c.x - 0.012f * sin(30.0f * (c.y - 0.01f));
    float leaf = inside(fmax(fabs(bend) - 0.0028f, fabs(c.y + 0.045f) - 0.055f), footprint);
    for (int side = -1; side <= 1; side += 2) {
        float2 d = c - (float2)(0.026f * side, -0.045f - 0.008f * side);
        d = (float2)(0.8f * d.x + 0.6f * side * d.y, 0.8f * d.y - 0.6f * side * d.x);
        leaf = fmax(leaf, inside((length(d / (float2)(0.026f, 0.010f)) - 1.0f) * 0.010f, footprint));
    }
    float stripe = 0.05f * inside(to_line(p.x, 0.12f) - 0.03f, footprint);
    float3 base = colour * (1.0f - stripe + 0.10f * octaves(p, 0.5f, 7, footprint, seed));
    float3 ink = second * (1.0f + 0.15f * octaves(p, 0.04f, 4, footprint, seed + 5u));
    return mix(mix(base, ink, leaf), mix(ink, second.zxy, 0.55f), petals);
}

static float3 weave(float2 p, float3 colour, float footprint, uint seed) {
    float thread = sin(p.x * 900.0f) * sin(p.y * 900.0f) * clamp(0.0035f / footprint - 2.0f, 0.0f, 1.0f);
    return colour * (1.0f + 0.14f * thread + 0.25f * octaves(p, 0.06f, 6, footprint, seed));
}

static float3 check(float2 p, float period, float3 colour, float3 second, float footprint, uint seed) {
    float a = inside(to_line(p.x, period) - 0.25f * period, footprint);
    float b = inside(to_line(p.y, period) - 0.25f * period, footprint);
    return weave(p, mix(colour, second, 0.5f * (a + b)), footprint, seed);
}

static float3 rug(float2 p, float2 half_size, float3 colour, float3 second, float footprint, uint seed) {
    float2 edge = half_size - fabs(p);
    float rim = fmin(edge.x, edge.y);
    float3 dark = 0.25f * colour, light = (float3)(0.70f, 0.62f, 0.48f);
    float2 cell = (float2)(to_line(p.x, 0.26f), to_line(p.y, 0.26f));
    float diamond = inside(cell.x + cell.y - 0.10f, footprint), heart = inside(cell.x + cell.y - 0.055f, footprint);
    float2 fine = (float2)(to_line(p.x, 0.065f), to_line(p.y, 0.065f));
    float dots = inside(length(fine) - 0.012f, footprint);
    float3 field = mix(mix(mix(colour, dark, 0.7f * dots), second, diamond), light, heart);
    float2 tooth = (float2)(to_line(p.x + p.y, 0.09f), to_line(p.x - p.y, 0.09f));
    float3 border = mix(second, light, inside(fmin(tooth.x, tooth.y) - 0.012f, footprint));
    float3 c = mix(field, border, inside(rim - 0.17f, footprint));
    c = mix(c, light, inside(fabs(rim - 0.17f) - 0.008f, footprint));
    c = mix(c, dark, inside(rim - 0.035f, footprint));
    return weave(p, c, footprint, seed) * (1.0f + 0.2f * octaves(p, 0.3f, 3, footprint, seed + 3u));
}

static float3 from_hue(float hue, float saturation, float value) {
    float3 k = (float3)(1.0f, 0.6667f, 0.3333f) + hue;
    k = fabs((k - floor(k)) * 6.0f - 3.0f) - 1.0f;
    return value * mix((float3)(1.0f), clamp(k, 0.0f, 1.0f), saturation);
}

// A picture on the wall; its seed says which of three kinds: hills, shapes, or rings.
static float3 painting(float2 p, float2 half_size, float footprint, uint seed) {
    float2 u = p / half_size.y;
    float edge = footprint / half_size.y, hue = random3(1, 1, seed);
    float3 c;
    if (seed % 3u == 0u) {
        c = mix(from_hue(0.10f + 0.08f * hue, 0.45f, 0.85f), from_hue(0.55f + 0.08f * hue, 0.55f, 0.55f),
                clamp(0.5f + 0.6f * u.y, 0.0f, 1.0f));
        float2 sun = u - (float2)(0.8f * hue - 0.4f, 0.35f);
        c = mix(c, (float3)(0.95f, 0.75f, 0.30f), inside(length(sun) - 0.16f, edge));
        for (int i = 0; i < 4; i++) {
            float ridge = 0.25f - 0.28f * i + 0.55f * octaves((float2)(u.x, 7.0f * i), 1.1f, 5, edge, seed + i);
            float3 hill = from_hue(0.28f + 0.09f * (3 - i) + 0.08f * hue, 0.5f, 0.42f - 0.09f * i);
            hill *= 1.0f + 0.35f * octaves(u, 0.12f, 4, edge, seed + 20u + i);
            c = mix(c, hill, inside(u.y - ridge, edge));
        }
    } else if (seed % 3u == 1u) {
        c = (float3)(0.72f, 0.67f, 0.56f);
        for (int i = 0; i < 14; i++) {
            float2 at = (float2)(random3(i, 2, seed), random3(i, 3, seed)) * 2.2f - 1.1f;
            float size = 0.10f + 0.30f * random3(i, 4, seed), turn = 6.28f * random3(i, 5, seed);
            float2 d = u - at;
            d = (float2)(cos(turn) * d.x + sin(turn) * d.y, cos(turn) * d.y - sin(turn) * d.x);
            float box = fmax(fabs(d.x) - size, fabs(d.y) - 0.3f * size);
            float shape = (i % 3 == 0) ? box : (i % 3 == 1) ? length(d) - 0.7f * size
                                                            : fabs(length(d) - size) - 0.025f;
            float3 ink = from_hue(hue + 0.37f * i, 0.75f, 0.12f + 0.65f * random3(i, 6, seed));
            c = mix(c, ink, 0.9f * inside(shape, edge));
        }
    } else {
        float2 q = u + 0.25f * (float2)(octaves(u, 0.9f, 3, edge, seed), octaves(u, 0.9f, 3, edge, seed + 9u));
        float ring = length(q - (float2)(0.2f, -0.1f)) * 6.0f, number = floor(ring);
        c = from_hue(hue + 0.11f * random3((int)number, 1, seed), 0.55f, 0.25f + 0.5f * random3((int)number, 2, seed));
        c *= 1.0f - 0.6f * inside((to_line(ring, 1.0f) - 0.05f) / 6.0f, edge);
    }
    return c * (1.0f + 0.22f * octaves(p, 0.05f, 6, footprint, seed + 50u));
}

// Spine of a book: bands, and a block that reads as a title. u along the thickness, v up.
static float3 book(float2 p, float2 half_size, float3 colour, float3 second, float footprint, uint seed) {
    float v = p.y / half_size.y;
    float band = 0.78f - 0.2f * random3(0, 0, seed);
    float bands = inside((fabs(fabs(v) - band) - 0.035f) * half_size.y, footprint);
    float letter = random3((int)floor(p.y / 0.007f), (int)floor(p.x / 0.004f), seed);
    float title = inside((fabs(v - 0.1f) - 0.38f) * half_size.y, footprint) *
                  inside(fabs(p.x) - 0.35f * half_size.x, footprint) *
                  mix(0.5f, step(0.45f, letter), clamp(0.007f / footprint - 0.5f, 0.0f, 1.0f));
    return mix(colour, second, fmax(bands, 0.8f * title)) * (1.0f + 0.2f * octaves(p, 0.03f, 4, footprint, seed));
}

// Lines of words on paper.
static float3 pages(float2 p, float2 half_size, float footprint, uint seed) {
    float2 rim = half_size - fabs(p);
    float line = floor(p.y / 0.0075f);
    float word = value_noise((float2)(p.x / 0.009f, line * 3.7f), seed);
    float ink = inside(to_line(p.y, 0.0075f) - 0.0019f, footprint) * smoothstep(-0.45f, -0.2f, word);
    ink *= inside(0.018f - fmin(rim.x, rim.y), footprint);
    return (float3)(0.78f, 0.74f, 0.66f) * (1.0f - 0.75f * ink);
}

static float3 leaf(float3 unit, float3 colour, float footprint, uint seed) {
    float vein = inside(fabs(unit.y) * 0.04f - 0.002f, footprint);
    float side = inside(to_line(unit.x * 0.12f + fabs(unit.y) * 0.05f, 0.025f) - 0.0012f, footprint);
    float tone = 1.0f + 0.3f * octaves(unit.xy * 0.1f, 0.05f, 4, footprint, seed);
    return colour * tone * (1.0f + 0.7f * vein + 0.35f * side);
}

static float3 clock_face(float2 p, float radius, float footprint) {
    float r = length(p) / radius, angle = atan2(p.x, p.y);
    float3 c = (float3)(0.80f, 0.78f, 0.72f);
    float tick = inside(to_line(angle, PI / 6.0f) * length(p) - 0.004f, footprint) *
                 inside((fabs(r - 0.82f) - 0.09f) * radius, footprint);
    float2 a = (float2)(0.50f, 0.87f), b = (float2)(-0.91f, 0.42f);  // ten past ten, mirrored by nobody
    float first = fmax(fabs(p.x * a.y - p.y * a.x) - 0.006f, fmax(-dot(p, a), dot(p, a) - 0.5f * radius));
    float second = fmax(fabs(p.x * b.y - p.y * b.x) - 0.004f, fmax(-dot(p, b), dot(p, b) - 0.75f * radius));
    return c * (1.0f - 0.93f * fmax(tick, fmax(inside(first, footprint), inside(second, footprint))));
}

// Reflectance of a primitive at a point of its surface (linear RGB); `footprint` is a pixel's size in metres.
static float3 albedo(__global const float *prim, float3 unit, int face, float footprint) {
    float3 colour = vload3(0, prim + PRIM_COLOUR), second = vload3(0, prim + PRIM_SECOND);
    float3 half_size = vload3(0, prim + PRIM_HALF), p = unit * half_size;
    uint seed = (uint)prim[PRIM_SEED];
    int material = (int)prim[PRIM_MATERIAL];
    float2 uv, extent;
    if ((int)prim[PRIM_SHAPE] == SHAPE_BOX) {
        int axis = face >> 1;
        uv = axis == 0 ? p.yz : axis == 1 ? p.xz : p.xy;
        extent = axis == 0 ? half_size.yz : axis == 1 ? half_size.xz : half_size.xy;
    } else if (face > 0) {
        uv = p.xy; extent = half_size.xy;
    } else {
        uv = (float2)(atan2(unit.y, unit.x) * half_size.x, p.z); extent = (float2)(PI * half_size.x, half_size.z);
    }
    switch (material) {
        case MAT_WOOD: {  // the grain follows the longest side
            float2 q = extent.y > extent.x ? uv.yx : uv;
            return wood(q + 0.37f * (float)(seed % 97u) + 0.11f * face, colour, footprint, seed);
        }
        case MAT_PARQUET: return parquet(uv, colour, footprint, seed);
        case MAT_PLASTER: return colour * (1.0f + 0.10f * octaves(uv, 0.9f, 8, footprint, seed) +
                                           0.06f * octaves(uv, 0.02f, 3, footprint, seed + 40u));
        case MAT_WALLPAPER: return wallpaper(uv, colour, second, footprint, seed);
        case MAT_PAINTING: return painting(uv, extent, footprint, seed);
        case MAT_WEAVE: return weave(uv, colour, footprint, seed);
        case MAT_CHECK: return check(uv, 0.08f, colour, second, footprint, seed);
        case MAT_STRIPES:
            return weave(uv, mix(colour, second, inside(to_line(uv.x, 0.05f) - 0.012f, footprint)), footprint, seed);
        case MAT_RUG: return rug(uv, extent, colour, second, footprint, seed);
        case MAT_BOOK: return book(uv, extent, colour, second, footprint, seed);
        case MAT_PAGES: return pages(uv, extent, footprint, seed);
        case MAT_LEAF: return leaf(unit, colour, footprint, seed);
        case MAT_CLOCK: return face == 2 ? clock_face(uv, half_size.x, footprint) : colour;
        case MAT_CERAMIC: {
            float band = inside(fabs(unit.z - 0.3f) * half_size.z - 0.012f, footprint);
            float wave = inside(fabs(p.z + 0.012f * sin(9.0f * atan2(unit.y, unit.x))) - 0.005f, footprint);
            return mix(colour, second, fmax(band, wave)) * (1.0f + 0.12f * octaves(uv, 0.03f, 4, footprint, seed));
        }
        default: return colour * (1.0f + 0.14f * octaves(uv, 0.08f, 6, footprint, seed));
    }
}

// What is seen through the window: sky, clouds, hills and trees far away. Linear radiance.
static float3 outside(float3 d, float angle) {
    float3 sky = mix((float3)(0.95f, 1.05f, 1.15f), (float3)(0.30f, 0.55f, 1.05f), clamp(2.2f * d.z, 0.0f, 1.0f));
    float2 q = d.xy / (fabs(d.z) + 0.25f);
    float cloud = smoothstep(0.0f, 0.45f, octaves(q, 1.2f, 6, 8.0f * angle, 11u) + 0.05f);
    sky = mix(sky, (float3)(1.35f), cloud * 0.8f);
    float azimuth = atan2(d.x, d.y);
    float hill = 0.07f + 0.10f * octaves((float2)(azimuth, 0.0f), 0.5f, 4, angle, 12u);
    float3 far_hill = (float3)(0.28f, 0.38f, 0.42f);
    sky = mix(sky, far_hill, inside(d.z - hill, angle));
    float tree = -0.03f + 0.12f * octaves((float2)(azimuth, 5.0f), 0.16f, 6, angle, 13u);
    float3 green = (float3)(0.16f, 0.26f, 0.08f) * (1.0f + 0.9f * octaves((float2)(azimuth, d.z), 0.05f, 5, angle, 14u));
    sky = mix(sky, green, inside(d.z - tree, angle));
    float3 lawn = (float3)(0.26f, 0.38f, 0.12f) * (1.0f + 0.4f * octaves((float2)(azimuth, 4.0f * d.z), 0.06f, 5, angle, 15u));
    return mix(sky, lawn, inside(d.z + 0.12f, angle));
}
