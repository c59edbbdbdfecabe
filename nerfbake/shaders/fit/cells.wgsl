// The cells of bricks: where they are, and their values. WGSL. Paste view.wgsl above this file.
//
//   bricks  two uint32 for each brick and one more: the number of its first cell; its place in the grid of its shell,
//           shell << 24 | x << 16 | y << 8 | z
//   places  an int16 for each cell, two in a word: place << 1 | wide in its brick, x-major
//   part    first brick, end, and first cell of the bricks in `values`, which is split where one binding is too small
//   values  float32: of each brick in turn all cells' first coefficient, all cells' second, ..., then all densities
@group(1) @binding(0) var<storage, read> bricks: array<vec2u>;
@group(1) @binding(1) var<storage, read> places: array<u32>;
@group(1) @binding(2) var<storage, read> part: vec4u;
@group(1) @binding(3) var<storage, read_write> values: array<f32>;
// Red, green and blue in the direction from the camera, and the density in 1/world unit, of each cell.
@group(1) @binding(4) var<storage, read_write> painted: array<vec4f>;

// A brick of this part: its first cell, its number of cells, and the first of its values.
struct Brick {
    first: u32,
    count: u32,
    start: u32,
    place: u32,
}

fn brickOf(number: u32) -> Brick {
    let here = bricks[number];
    return Brick(here.x, bricks[number + 1u].x - here.x, (3u * u32(B) + 1u) * (here.x - part.z), here.y);
}

fn placeOf(cell: u32) -> u32 {
    return places[cell >> 1u] >> (16u * (cell & 1u));
}

// The unit vector from the camera to the centre of a cell.
fn lookAt(brick: Brick, place: u32) -> vec3f {
    let shell = view.shells[brick.place >> 24u];
    let corner = vec3f(vec3u(brick.place >> 16u, brick.place >> 8u, brick.place) & vec3u(255u)) * 8.0;
    let within = vec3f(vec3u(place >> 7u, place >> 4u, place >> 1u) & vec3u(7u)) + 0.5 * f32(1u + (place & 1u));
    let away = (corner + within - shell.place.xyz) * shell.size.xyz;
    return away * inverseSqrt(dot(away, away) + 1e-30);
}

// Widths of a cell in which its density is measured, in a world unit.
fn perWidth(brick: Brick, place: u32) -> f32 {
    return (1.0 - 0.5 * f32(place & 1u)) / view.shells[brick.place >> 24u].size.w;
}
