/* What is beside the panorama's rim. Cells are those of the masks' grid, of a working pixel or a few. */

/* The cell that a pixel of the working grid is in. */
static inline int2 rim_cell(int2 p, int4 border, int4 cells) {
    const int2 at = floor_int2((convert_float2(p) + 0.5f) * grid_ratio(border, cells));
    return (int2)(LEAST(at.x, cells.x - 1), LEAST(at.y, cells.y - 1));
}

/* Have a layer weigh less by what its cells say. */
__kernel void rim_fade(__global float4 *field,      /* (box.w, box.z) displacement, weight; in place */
                       int4 box, int4 border,       /* place on the working grid, run size; the grid */
                       __global const float *left,  /* (cells.y, cells.x) 0..1 */
                       int4 cells)                  /* over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int2 cell = rim_cell((int2)(x + box.x, y + box.y), border, cells);
    field[y * box.z + x].w *= left[cell.y * cells.x + cell.x];
}

/* Of a strip's thickness, how far a layer is displaced towards the rim in it at most. */
#define RIM_FURTHEST 0.75f

/* Carry a layer's field to where another cell is named as source, from the pixel in the middle of that, if the layer
   shows anything there. No source has one itself. Towards the rim displacements get less, evenly, so that none leads
   beyond: there is nothing. */
__kernel void rim_carry(__global float4 *field,         /* (box.w, box.z) displacement, weight; in place */
                        __global const float4 *layer,   /* (box.w, box.z) r, g, b, valid */
                        int4 box, int4 border,          /* place on the working grid, run size; the grid */
                        float4 lonlat,
                        __global const int *source,     /* (cells.y, cells.x) number of a cell; -1: none */
                        __global const float4 *outward, /* (cells.y, cells.x) towards the rim, x and y, of length 1; how
                                                           far it is, of the strip's thickness; that, working px */
                        int4 cells)                     /* over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int2 cell = rim_cell((int2)(x + box.x, y + box.y), border, cells);
    const int number = cell.y * cells.x + cell.x, from = source[number];
    if (from < 0)
        return;
    const int at = box_index(floor_int2(grid_place(from % cells.x, from / cells.x, cells, border)), box);
    if (at < 0 || layer[at].w == 0.0f)
        return;
    float4 carried = field[at];
    if (square3(carried.xyz) > 0.0f) {
        const float2 q = (float2)(x + box.x + 0.5f, y + box.y + 0.5f);
        const float2 there = layer_near(q, carried.xyz, lonlat), way = there - q;
        const float4 out = outward[number];
        const float far = way.x * out.x + way.y * out.y;
        const float kept = LEAST(far, RIM_FURTHEST * out.w) * out.z;
        if (far > kept)
            carried.xyz = canvas_point(there - (far - kept) * out.xy, lonlat) - canvas_point(q, lonlat);
    }
    field[y * box.z + x] = carried;
}
