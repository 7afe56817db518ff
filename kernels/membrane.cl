/* Displacements of what is taken from one layer, whole: smooth, whatever flow found there. */

/* The mean displacement of a layer's pixels in a cell, and 1; zeros where it has none. */
__kernel void membrane_mean(__global const float4 *layer, __global const float4 *field, /* (box.w, box.z) */
                            int4 box,                /* place on the working grid */
                            int4 border, int4 cells, /* working grid; grid of the cells, run size */
                            __global float4 *mean)   /* (cells.y, cells.x) */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    const int4 its = cell_pixels(cx, cy, border, cells);
    float4 sum = (float4)(0.0f);
    for (int y = its.y; y < its.w; ++y)
        for (int x = its.x; x < its.z; ++x) {
            const int at = box_index((int2)(x, y), box);
            if (at >= 0 && layer[at].w > 0.0f)
                sum += (float4)(field[at].xyz, 1.0f);
        }
    mean[cy * cells.x + cx] = sum.w > 0.0f ? sum / sum.w : (float4)(0.0f);
}

/* In place of a layer's displacements, as far as cells tell others, these; bilinear between the cells' centres. */
__kernel void membrane_stretch(__global float4 *field,        /* (box.w, box.z) of the working grid; x, y, z change */
                               int4 box, int4 border,         /* place on the working grid, run size; that grid */
                               __global const float4 *smooth, /* (cells.y, cells.x): displacement times how far, 0..1;
                                                                 how far */
                               int4 cells)                    /* over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float4 other = bilinear_colour(smooth, grid_place(x + box.x, y + box.y, border, cells), cells);
    if (other.w > 0.0f) {
        const float4 own = field[y * box.z + x];
        field[y * box.z + x] = (float4)((1.0f - other.w) * own.xyz + other.xyz, own.w);
    }
}
