// Ray tracer of the sample room: bounding-volume walk and baked light; follows textures.cl.
//
// World: metres, x right (east), y ahead (north), z up. A primitive is a unit shape (box [-1,1]^3, sphere of
// radius 1, or frustum of radius 1 at z = -1 and `taper` at z = 1) under an affine map; see PRIM_* there.
// Light is diffuse only, so it is the same from everywhere: `bake_*` stores it once per texel of each
// surface, and `render` multiplies it by the texture. The SHAPE_* and MAT_* constants come from scene.py.

#define FAR 1e9f

typedef struct { float t; int prim; float3 unit; int face; } Hit;

// -------------------------------------------------------------------------------------- intersections

static float3 transform_point(__global const float *m, float3 p) {
    return (float3)(m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3], m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7],
                    m[8] * p.x + m[9] * p.y + m[10] * p.z + m[11]);
}

static float3 transform_vector(__global const float *m, float3 v) {
    return (float3)(m[0] * v.x + m[1] * v.y + m[2] * v.z, m[4] * v.x + m[5] * v.y + m[6] * v.z,
                    m[8] * v.x + m[9] * v.y + m[10] * v.z);
}

static float sphere_hit(float3 o, float3 d) {
    float a = dot(d, d), b = dot(o, d), c = dot(o, o) - 1.0f, q = b * b - a * c;
    if (q < 0.0f) return FAR;
    q = sqrt(q);
    float t = (-b - q) / a;
    return t > 0.0f ? t : (-b + q) / a > 0.0f ? (-b + q) / a : FAR;
}

static float box_hit(float3 o, float3 d, int *face) {
    float3 inverse = 1.0f / d;
    float3 a = (-1.0f - o) * inverse, b = (1.0f - o) * inverse;
    float3 near3 = fmin(a, b), far3 = fmax(a, b);
    float enter = fmax(fmax(near3.x, near3.y), near3.z), leave = fmin(fmin(far3.x, far3.y), far3.z);
    if (enter > leave || enter <= 0.0f) return FAR;
    int axis = enter == near3.x ? 0 : enter == near3.y ? 1 : 2;
    float along = axis == 0 ? d.x : axis == 1 ? d.y : d.z;
    *face = 2 * axis + (along < 0.0f);
    return enter;
}

// Faces: 0 the side, 1 the bottom cap, 2 the top cap.
static float frustum_hit(float3 o, float3 d, float taper, int *face) {
    float middle = 0.5f * (1.0f + taper), slope = 0.5f * (taper - 1.0f), best = FAR;
    float ro = middle + slope * o.z, rd = slope * d.z;
    float a = d.x * d.x + d.y * d.y - rd * rd, b = o.x * d.x + o.y * d.y - ro * rd;
    float c = o.x * o.x + o.y * o.y - ro * ro, q = b * b - a * c;
    if (q >= 0.0f && fabs(a) > 1e-12f) {
        q = sqrt(q);
        float first = (-b - q) / a, second = (-b + q) / a;
        if (first > second) { float swap = first; first = second; second = swap; }
        float z = o.z + first * d.z;
        if (first > 0.0f && fabs(z) <= 1.0f) { best = first; *face = 0; }
        z = o.z + second * d.z;
        if (best == FAR && second > 0.0f && fabs(z) <= 1.0f) { best = second; *face = 0; }
    }
    for (int side = 0; side < 2; side++) {
        float t = ((side ? 1.0f : -1.0f) - o.z) / d.z, radius = side ? taper : 1.0f;
        float x = o.x + t * d.x, y = o.y + t * d.y;
        if (t > 0.0f && t < best && x * x + y * y <= radius * radius) { best = t; *face = 1 + side; }
    }
    return best;
}

// Nearest hit before `limit`; with `any`, the first one found will do.
//   bounds: nodes x 8 floats: low xyz, high xyz, index of the node to go on with when missed, primitive or -1
static Hit trace(__global const float *prims, __global const float *bounds, int nodes, float3 o, float3 d,
                 float limit, int any) {
    Hit hit; hit.t = limit; hit.prim = -1; hit.unit = (float3)(0.0f); hit.face = 0;
    float3 inverse = 1.0f / d;
    int node = 0;
    while (node < nodes) {
        __global const float *box = bounds + 8 * node;
        float3 a = (vload3(0, box) - o) * inverse, b = (vload3(0, box + 3) - o) * inverse;
        float3 low = fmin(a, b), high = fmax(a, b);
        float enter = fmax(fmax(low.x, low.y), fmax(low.z, 0.0f)), leave = fmin(fmin(high.x, high.y), high.z);
        if (enter > leave || enter >= hit.t) { node = (int)box[6]; continue; }
        int index = (int)box[7];
        if (index >= 0) {
            __global const float *prim = prims + PRIM_STRIDE * index;
            float3 lo = transform_point(prim + PRIM_INVERSE, o), ld = transform_vector(prim + PRIM_INVERSE, d);
            int face = 0, shape = (int)prim[PRIM_SHAPE];
            float t = shape == SHAPE_BOX ? box_hit(lo, ld, &face)
                    : shape == SHAPE_SPHERE ? sphere_hit(lo, ld) : frustum_hit(lo, ld, prim[PRIM_TAPER], &face);
            if (t < hit.t) {
                hit.t = t; hit.prim = index; hit.face = face; hit.unit = lo + t * ld;
                if (any) return hit;
            }
        }
        node++;
    }
    return hit;
}

static float3 unit_normal(__global const float *prim, float3 unit, int face) {
    int shape = (int)prim[PRIM_SHAPE];
    if (shape == SHAPE_BOX) {
        float s = face & 1 ? 1.0f : -1.0f;
        return (float3)((face >> 1) == 0 ? s : 0.0f, (face >> 1) == 1 ? s : 0.0f, (face >> 1) == 2 ? s : 0.0f);
    }
    if (shape == SHAPE_SPHERE) return unit;
    if (face > 0) return (float3)(0.0f, 0.0f, face == 2 ? 1.0f : -1.0f);
    float slope = 0.5f * (prim[PRIM_TAPER] - 1.0f);
    return (float3)(unit.x, unit.y, -slope * length(unit.xy));
}

// ---------------------------------------------------------------------------------------- light maps
// Per face a grid of texels, the outermost on the face's edge, so that neighbouring faces and both ends of
// a round one meet. Box: faces -x +x -y +y -z +z. Round: the side (around x along), then two caps.

static int2 face_size(__global const float *prim, int face) {
    int a = (int)prim[PRIM_COUNTS], b = (int)prim[PRIM_COUNTS + 1], c = (int)prim[PRIM_COUNTS + 2];
    if ((int)prim[PRIM_SHAPE] == SHAPE_BOX) return (face >> 1) == 0 ? (int2)(b, c) : (face >> 1) == 1 ? (int2)(a, c) : (int2)(a, b);
    return face == 0 ? (int2)(a, b) : (int2)(c, c);
}

static int face_start(__global const float *prim, int face) {
    int start = (int)prim[PRIM_TEXEL];
    for (int f = 0; f < face; f++) { int2 size = face_size(prim, f); start += size.x * size.y; }
    return start;
}

// Place on a face, 0..1 in both directions.
static float2 face_place(__global const float *prim, float3 unit, int face) {
    float2 p;
    if ((int)prim[PRIM_SHAPE] == SHAPE_BOX) p = (face >> 1) == 0 ? unit.yz : (face >> 1) == 1 ? unit.xz : unit.xy;
    else if (face > 0) p = unit.xy / fmax(1.0f, face == 2 ? prim[PRIM_TAPER] : 1.0f);
    else p = (float2)(atan2(unit.y, unit.x) / PI, unit.z);
    return clamp(0.5f * p + 0.5f, 0.0f, 1.0f);
}

static float3 face_point(__global const float *prim, float2 place, int face) {
    float2 p = 2.0f * place - 1.0f;
    int shape = (int)prim[PRIM_SHAPE];
    if (shape == SHAPE_BOX) {
        float s = face & 1 ? 1.0f : -1.0f;
        return (face >> 1) == 0 ? (float3)(s, p) : (face >> 1) == 1 ? (float3)(p.x, s, p.y) : (float3)(p, s);
    }
    if (face > 0) {
        float radius = face == 2 ? prim[PRIM_TAPER] : 1.0f, reach = length(p);
        p *= 0.999f * radius / fmax(1.0f, reach);  // corners of the square lie outside the disc: use its rim
        return (float3)(p, face == 2 ? 1.0f : -1.0f);
    }
    float angle = PI * p.x, z = p.y;
    float radius = shape == SHAPE_SPHERE ? sqrt(fmax(0.0f, 1.0f - z * z))
                                         : 0.5f * (1.0f + prim[PRIM_TAPER]) + 0.5f * (prim[PRIM_TAPER] - 1.0f) * z;
    return (float3)(radius * cos(angle), radius * sin(angle), z);
}

static float3 light_at(__global const float *prims, __global const float *light, int index, float3 unit, int face) {
    __global const float *prim = prims + PRIM_STRIDE * index;
    int2 size = face_size(prim, face);
    float2 place = face_place(prim, unit, face) * (float2)(size.x - 1, size.y - 1);
    int x = min((int)place.x, size.x - 2), y = min((int)place.y, size.y - 2);
    float2 f = place - (float2)(x, y);
    int at = face_start(prim, face) + y * size.x + x;
    return mix(mix(vload3(at, light), vload3(at + 1, light), f.x),
               mix(vload3(at + size.x, light), vload3(at + size.x + 1, light), f.x), f.y);
}

// World position (lifted off the surface) and normal of one texel.
//   texels: count x 4 ints: primitive, face, column, row
static void texel_frame(__global const float *prims, __global const int *texels, int i, float3 *point, float3 *normal) {
    __global const float *prim = prims + PRIM_STRIDE * texels[4 * i];
    int face = texels[4 * i + 1];
    int2 size = face_size(prim, face);
    // a hair inside the edge, so that a texel at the edge does not sit within the neighbour
    float2 place = (float2)(texels[4 * i + 2], texels[4 * i + 3]) / (float2)(size.x - 1, size.y - 1);
    float3 unit = face_point(prim, 0.004f + 0.992f * place, face);
    float3 n = unit_normal(prim, unit, face);
    __global const float *m = prim + PRIM_INVERSE;  // normals go with the transposed inverse
    *normal = normalize((float3)(m[0] * n.x + m[4] * n.y + m[8] * n.z, m[1] * n.x + m[5] * n.y + m[9] * n.z,
                                 m[2] * n.x + m[6] * n.y + m[10] * n.z));
    *point = transform_point(prim + PRIM_FORWARD, unit) + 1e-3f * *normal;
}

// Sun, window and lamps at each texel, with soft shadows. Run size: texels.
//   lights: per light 16 floats: kind, colour, then
//     0 sun:    direction to it, half-angle in radians
//     1 window: centre, half extents as two vectors (a rectangle that faces -y)
//     2 lamp:   centre, radius
//   direct: texels x 3, irradiance / pi
__kernel void bake_direct(__global const float *prims, __global const float *bounds, const int nodes,
                          __global const int *texels, const int count, __global const float *lights,
                          const int light_count, const int samples, __global float *direct) {
    int i = get_global_id(0);
    if (i >= count) return;
    float3 point, normal, sum = (float3)(0.0f);
    texel_frame(prims, texels, i, &point, &normal);
    for (int k = 0; k < light_count; k++) {
        __global const float *light = lights + 16 * k;
        float3 colour = vload3(0, light + 1), at = vload3(0, light + 4);
        int kind = (int)light[0], taken = kind == 1 ? samples : (samples + 1) / 2;
        float received = 0.0f;
        for (int s = 0; s < taken; s++) {
            // a lattice over the light, shifted per texel: soft edges without bands
            float a = (s + 0.5f) / taken, b = s * 0.618034f + random3(i, k, 5u);
            b -= floor(b);
            float angle = 2.0f * PI * b, radius = sqrt(a), gain;
            float3 to;
            if (kind == 0) {
                float3 side = normalize(cross(at, (float3)(0.3f, 0.2f, 0.9f)));
                to = at + light[7] * radius * (cos(angle) * side + sin(angle) * cross(at, side));
                gain = fmax(0.0f, dot(normalize(to), normal));
                to *= 50.0f;
            } else {
                float3 target = kind == 1 ? at + (2.0f * a - 1.0f) * vload3(0, light + 7) + (2.0f * b - 1.0f) * vload3(0, light + 10)
                                          : at;
                if (kind == 2) {  // the half of the ball that faces the texel
                    float3 axis = normalize(point - at), side = normalize(cross(axis, (float3)(0.3f, 0.2f, 0.9f)));
                    target += light[7] * (radius * (cos(angle) * side + sin(angle) * cross(axis, side)) + 0.3f * axis);
                }
                to = target - point;
                float far2 = dot(to, to);
                float facing = kind == 1 ? fmax(0.0f, to.y * rsqrt(far2)) : 1.0f;
                gain = fmax(0.0f, dot(to, normal) * rsqrt(far2)) * facing / (far2 + 0.01f);
                to *= 0.995f;
            }
            if (gain > 0.0f && trace(prims, bounds, nodes, point, to, 1.0f, 1).prim < 0) received += gain;
        }
        sum += colour * received / taken;
    }
    vstore3(sum, i, direct);
}

// One bounce: what the surfaces around, lit by `light`, send to each texel. Run size: texels.
//   bounced: texels x 3
__kernel void bake_bounce(__global const float *prims, __global const float *bounds, const int nodes,
                          __global const int *texels, const int count, __global const float *light,
                          const int samples, __global float *bounced) {
    int i = get_global_id(0);
    if (i >= count) return;
    float3 point, normal, sum = (float3)(0.0f);
    texel_frame(prims, texels, i, &point, &normal);
    float3 side = normalize(cross(normal, fabs(normal.z) < 0.8f ? (float3)(0.0f, 0.0f, 1.0f) : (float3)(1.0f, 0.0f, 0.0f)));
    float3 third = cross(normal, side);
    for (int s = 0; s < samples; s++) {
        float a = (s + 0.5f) / samples, angle = 2.0f * PI * (s * 0.618034f + random3(i, 1, 6u)), radius = sqrt(a);
        float3 d = radius * (cos(angle) * side + sin(angle) * third) + sqrt(1.0f - a) * normal;
        Hit hit = trace(prims, bounds, nodes, point, d, FAR, 0);
        if (hit.prim < 0) continue;
        __global const float *prim = prims + PRIM_STRIDE * hit.prim;
        if ((int)prim[PRIM_MATERIAL] == MAT_GLOW) continue;  // lamps are counted in bake_direct
        sum += albedo(prim, hit.unit, hit.face, 0.15f) * light_at(prims, light, hit.prim, hit.unit, hit.face);
    }
    vstore3(sum / samples, i, bounced);
}

static float3 tone(float3 radiance) {
    float3 x = 1.0f - exp(-radiance);
    return pow(clamp(x, 0.0f, 1.0f), 1.0f / 2.2f);
}

// Colours of rays from one point. Run size: rays.
//   rays:    count x 9 floats: direction (unit length), its change per pixel to the right, and per pixel down
//   grid:    samples per pixel and axis
//   colours: count x 3, display values 0..1
//   depths:  count, distance in metres along the central ray; 1000 where nothing is hit
__kernel void render(__global const float *prims, __global const float *bounds, const int nodes,
                     __global const float *light, const float eye_x, const float eye_y, const float eye_z,
                     __global const float *rays, const int count, const int grid, const float exposure,
                     __global float *colours, __global float *depths) {
    int i = get_global_id(0);
    if (i >= count) return;
    float3 eye = (float3)(eye_x, eye_y, eye_z);
    float3 centre = vload3(3 * i, rays), right = vload3(3 * i + 1, rays), down = vload3(3 * i + 2, rays);
    float angle = sqrt(length(right) * length(down)) * (grid > 1 ? 0.7f : 1.0f);
    float3 sum = (float3)(0.0f);
    for (int s = 0; s < grid * grid; s++) {
        float x = (s % grid + 0.5f) / grid - 0.5f, y = (s / grid + 0.5f) / grid - 0.5f;
        float3 d = normalize(centre + x * right + y * down);
        Hit hit = trace(prims, bounds, nodes, eye, d, FAR, 0);
        float3 radiance;
        if (hit.prim < 0) radiance = 1.1f * outside(d, angle);
        else {
            __global const float *prim = prims + PRIM_STRIDE * hit.prim;
            if ((int)prim[PRIM_MATERIAL] == MAT_GLOW) radiance = vload3(0, prim + PRIM_COLOUR);
            else radiance = albedo(prim, hit.unit, hit.face, angle * hit.t) *
                            light_at(prims, light, hit.prim, hit.unit, hit.face);
        }
        sum += tone(exposure * radiance);
    }
    vstore3(sum / (float)(grid * grid), i, colours);
    depths[i] = fmin(1000.0f, trace(prims, bounds, nodes, eye, centre, FAR, 0).t);
}
