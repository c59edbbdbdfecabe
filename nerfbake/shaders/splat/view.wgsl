// What the passes of a picture of splats know about its camera. WGSL.
//
// A picture is the passes project, scan, spread, a sort and blend. They do what kernels/splat does, and their names are
// those there. Positions of splats count from `anchor`, the point of the scene's box that is nearest to the camera:
// float32 is exact where splats look large.
const EDGE = 16u;         // pixels along an edge of a tile
const PAD = 0.05;         // pixels: more than the rounding of a half-width
const SEEN = 1.0 / 255.0; // smallest alpha that is blended

struct View {
    turn: array<vec4f, 3>,  // rows of the matrix from the world to the camera's axes, right, down, forward; w: the anchor
    anchor: vec4f,
    away: vec4f,            // from the camera to the anchor, in the world's axes
    optics: vec4f,          // fx, fy, cx, cy in pixels
    limits: vec4f,          // least and largest x / z, least and largest y / z in the Jacobian
    bounds: vec4f,          // left, top, right, bottom of the picture, in pixels
    squares: vec4f,         // products of the camera's axes: xx, yy, zz
    products: vec4f,        // xy, xz, yz
    background: vec4f,
    width: u32,             // of the picture
    height: u32,
    columns: u32,           // of tiles
    rows: u32,
    begin: u32,             // the rows of tiles that are made are begin .. end
    end: u32,
    count: u32,             // splats in `order`
    total: u32,             // of the scene; there are as many rows
    room: u32,              // of the buffers of entries
    coefficients: u32,      // of each colour
    antialiased: u32,
    bent: u32,              // the pixels do not form a grid
}

@group(0) @binding(0) var<uniform> view: View;

fn threadOf(id: vec3u, groups: vec3u) -> u32 {
    return id.y * groups.x * 64u + id.x;
}
