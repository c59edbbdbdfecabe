// What all passes of a fit know about the view that is visited, and the tables of the bricks. WGSL.
//
// One visit is the passes paint, march, residual, march again with `back`, step and, where densities are interpolated,
// corners. Sums are integers with view.unit steps a unit, so they are the same in any order. A tie of the cells is the
// passes gather and tie for each coefficient. Paste harmonics.wgsl and `const B = 9;`, the number of coefficients of a
// channel, above this file.
const SHELLS = 8;
const FRESH = 1u;   // bits of view.flags: the first visit of an epoch, which clears the blame
const BENT = 2u;    // `bent` has the directions of the rays
const COUNTED = 4u; // the sums of the picture are needed

struct Shell {
    place: vec4f,  // the camera, in cells of the shell
    size: vec4f,   // of a cell in world units along x, y, z, and the edge of a cube with its volume
}

struct View {
    optics: vec4f,            // fx, fy, cx, cy in pixels
    turn: array<vec4f, 3>,    // rows of the matrix from the camera's axes to the world's
    background: vec4f,
    gains: vec4f,             // the factor of each channel between the field's colours and those of the picture
    losses: vec4f,            // weights of alpha, of the colour of each cell and of distortion; the middle of its scale
    limits: vec4f,            // the largest residual, the largest mean residual, steps a unit of the sums, 1 / steps
    rates: vec4f,             // of densities, colours and raw densities; 1 / rays of a pixel
    parts: array<vec4f, 2>,   // each band's share of a step, in order
    ridge: array<vec4f, 2>,   // each band's ridge
    pixels: u32,              // pixels of the view that are fitted
    width: u32,               // of the picture
    samples: u32,             // rays along each edge of a pixel
    flags: u32,
    edge: u32,                // bricks along an axis of a shell
    shellCount: u32,
    slot: u32,                // of the view in `totals`
    tilt: f32,                // a ray at (x, y) from the middle of its pixel moves by tilt (y, -x)
    shells: array<Shell, SHELLS>,
    tie: f32,                 // the strength of the tie, see tie.wgsl
    tieEdge: f32,             // a difference of densities: a neighbour with this one counts half
    coefficient: u32,         // of each channel that is tied; B: the densities
    depth: f32,               // weight of the depth loss
}

@group(0) @binding(0) var<uniform> view: View;

// The number of a thread in a grid of two axes with 64 threads a workgroup.
fn threadOf(id: vec3u, groups: vec3u) -> u32 {
    return id.y * groups.x * 64u + id.x;
}

fn ofBand(values: array<vec4f, 2>, k: i32) -> f32 {
    if k < 1 { return values[0].x; }
    if k < 4 { return values[0].y; }
    if k < 9 { return values[0].z; }
    if k < 16 { return values[0].w; }
    return values[1].x;
}
