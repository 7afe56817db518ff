/* Mask-normalised filters and pyramids: what lies outside a mask never enters a sum. */

/* Halve an image, by taps around each pair of pixels, so that coarse position = fine / 2. */
__kernel void pyramid_reduce(__global const float *image, /* (fine.y, fine.x) */
                             __global const float *mask,  /* (fine.y, fine.x), 0 or 1 */
                             int4 fine,                   /* width, height, wraps, 0 */
                             __global float *small_image, /* (size.y, size.x) */
                             __global float *small_mask,  /* (size.y, size.x), 0 or 1 */
                             int2 size)                   /* coarse size; run size */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float taps[4] = HALVING_TAPS;
    float sum = 0.0f, weight = 0.0f;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            int2 p = (int2)(2 * x - 1 + i, 2 * y - 1 + j);
            if (!grid_border(&p, fine))
                continue;
            const float w = taps[i] * taps[j] * mask[p.y * fine.x + p.x];
            sum += w * image[p.y * fine.x + p.x];
            weight += w;
        }
    const bool valid = weight >= 0.5f;
    small_image[y * size.x + x] = valid ? sum / weight : 0.0f;
    small_mask[y * size.x + x] = valid ? 1.0f : 0.0f;
}

/* One direction of a Gaussian, mask-normalised at the end: call with step (1, 0) on (image x mask, mask), then
   with (0, 1) and `normalise` on the two results. */
__kernel void pyramid_smooth(__global const float *image,  /* (grid.y, grid.x), already times mask */
                             __global const float *weight, /* (grid.y, grid.x) */
                             int4 grid,                    /* width, height, wraps, 0; run size */
                             int2 step,                    /* (1, 0) or (0, 1) */
                             __global const float *taps,   /* (radius + 1) from the centre outwards */
                             int radius,                   /* px */
                             int normalise,                /* 1: divide image by weight */
                             __global float *image_out,    /* (grid.y, grid.x) */
                             __global float *weight_out)   /* (grid.y, grid.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid.x || y >= grid.y)
        return;
    float sum = 0.0f, total = 0.0f;
    for (int i = -radius; i <= radius; ++i) {
        int2 p = (int2)(x, y) + i * step;
        if (!grid_border(&p, grid))
            continue;
        const float g = taps[MAGNITUDE(i)];
        sum += g * image[p.y * grid.x + p.x];
        total += g * weight[p.y * grid.x + p.x];
    }
    image_out[y * grid.x + x] = normalise ? (total > 1e-6f ? sum / total : 0.0f) : sum;
    weight_out[y * grid.x + x] = total;
}
