/* Arithmetic that every kernel shares, in front of common.cl.

   What runs for every pixel is written with operators: where PoCL's library is compiled for another processor
   than the kernel, each floor, clamp or fmin is a call, and all that is in vector registers is saved around it. */

/* Of two scalars or vectors of one type; the second where the first is not a number. */
#define LEAST(a, b) ((a) < (b) ? (a) : (b))
#define GREATEST(a, b) ((a) > (b) ? (a) : (b))
#define LIMITED(a, low, high) ((a) < (low) ? (low) : (a) < (high) ? (a) : (high))
#define MAGNITUDE(a) ((a) < 0 ? -(a) : (a))

/* PoCL's compiler has an instruction for it, its library a function. */
#ifdef POCL_DEVICE_ADDRESS_BITS
#define ROOT(a) __builtin_sqrtf(a)
#else
#define ROOT(a) sqrt(a)
#endif

static inline float root(float a) {
    return ROOT(a);
}

static inline float4 root4(float4 a) {
    return (float4)(ROOT(a.x), ROOT(a.y), ROOT(a.z), ROOT(a.w));
}

/* How far a is from `low` to `high`, 0..1: what counts not at all up to one limit, and wholly from another one on. */
static inline float ramp(float a, float low, float high) {
    const float share = (a - low) / (high - low);
    return LIMITED(share, 0.0f, 1.0f);
}

/* The largest whole number that is not above a. */
static inline int floor_int(float a) {
    const int whole = (int)a;
    return whole - (a < whole ? 1 : 0);
}

static inline int2 floor_int2(float2 a) {
    return (int2)(floor_int(a.x), floor_int(a.y));
}

/* Squared lengths. */
static inline float square2(float2 a) {
    return a.x * a.x + a.y * a.y;
}

static inline float square3(float3 a) {
    return a.x * a.x + a.y * a.y + a.z * a.z;
}

/* exp(a) to 1e-7, exactly 1 for 0, of -87 to 88: a power of two times a polynomial fitted to 2^t over 0..1. */
#define EXPONENTIAL(n)                                                                                             \
    static inline float##n exponential##n(float##n a) {                                                            \
        const float##n y = a * 1.44269504f;                                                                        \
        int##n whole = convert_int##n(y);                                                                          \
        whole -= y < convert_float##n(whole) ? (int##n)(1) : (int##n)(0);                                          \
        const float##n t = y - convert_float##n(whole);                                                            \
        const float##n upper = 0.0557999383f + t * (0.00901699517f + t * 0.00186714665f);                          \
        const float##n power = 1.0f + t * (0.693151312f + t * (0.240164443f + t * upper));                         \
        return power * as_float##n((whole + 127) << 23);                                                           \
    }
EXPONENTIAL()
EXPONENTIAL(4)

/* The natural logarithm of a normal number above 0, to 1e-7: of its power of two, and of what is left, between the
   roots of 1/2 and 2, by the series of the inverse hyperbolic tangent. */
#define LOGARITHM(n)                                                                                               \
    static inline float##n logarithm##n(float##n a) {                                                              \
        const int##n bits = as_int##n(a) - 0x3f3504f3;                                                             \
        const float##n m = as_float##n((bits & 0x007fffff) + 0x3f3504f3);                                          \
        const float##n t = (m - 1.0f) / (m + 1.0f), t2 = t * t;                                                    \
        const float##n upper = 0.2f + t2 * (0.142857143f + t2 * 0.111111111f);                                     \
        return convert_float##n(bits >> 23) * 0.693147181f + 2.0f * t * (1.0f + t2 * (0.333333333f + t2 * upper)); \
    }
LOGARITHM()
LOGARITHM(4)

/* Sine, and by its address cosine, of an angle of a few turns at most, to 1e-7: positions are calculated several
   times for each pixel, and PoCL's own functions, good for any angle, take four times as long. And atan2 likewise;
   0 where both are 0. */
#define ANGLES(n)                                                                                                  \
    static inline float##n angle_sincos##n(float##n angle, float##n *cosine) {                                     \
        const float##n turns = angle * M_2_PI_F + 0.5f;                                                            \
        int##n turn = convert_int##n(turns);                                                                       \
        turn -= turns < convert_float##n(turn) ? (int##n)(1) : (int##n)(0);                                        \
        const float##n quarter = convert_float##n(turn);                                                           \
        /* pi / 2 in two parts, so that nothing is lost */                                                         \
        const float##n r = (angle - quarter * 1.5707962513f) - quarter * 7.5497894e-8f, r2 = r * r;                \
        const float##n s = r + r * r2 * (-0.166666502f + r2 * (0.00833195158f - r2 * 0.000194922077f));            \
        const float##n c = 1.0f - 0.5f * r2 +                                                                      \
                           r2 * r2 * (0.0416666463f + r2 * (-0.00138873371f + r2 * 2.44348453e-5f));               \
        const float##n first = (turn & 1) != 0 ? c : s, second = (turn & 1) != 0 ? s : c;                          \
        *cosine = ((turn + 1) & 2) != 0 ? -second : second;                                                        \
        return (turn & 2) != 0 ? -first : first;                                                                   \
    }                                                                                                              \
    static inline float##n angle_of##n(float##n y, float##n x) {                                                   \
        const float##n ax = MAGNITUDE(x), ay = MAGNITUDE(y), longer = GREATEST(ax, ay);                            \
        const float##n t = longer > 0.0f ? LEAST(ax, ay) / longer : (float##n)(0.0f), t2 = t * t;                  \
        const float##n far = 0.0964219166f + t2 * (-0.055912249f + t2 * (0.0218629038f - t2 * 0.00405455219f));    \
        const float##n near = -0.333298607f + t2 * (0.199465652f + t2 * (-0.139086273f + t2 * far));               \
        float##n angle = t * (0.999999336f + t2 * near);                                                           \
        angle = ay > ax ? M_PI_2_F - angle : angle;                                                                \
        angle = x < 0.0f ? M_PI_F - angle : angle;                                                                 \
        return as_int##n(y) < 0 ? -angle : angle; /* by the sign bit: -0 is below 0 */                             \
    }
ANGLES()
ANGLES(4)
