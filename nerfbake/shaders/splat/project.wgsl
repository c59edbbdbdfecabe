// Project splats to the picture, and count the tiles that each reaches into. A thread for each splat. WGSL.
// Paste harmonics.wgsl, view.wgsl and tiles.wgsl above this file.
//
//   order   uint32 for each row: the number of its splat, nearest first
//   solids  three vec4f for each splat: mean and opacity; scales; quaternion w, x, y, z
//   sh      float32: view.coefficients times red, green, blue for each splat
//   rows    four vec4f for each row, see Row
//   counts  uint32 for each row: its tiles, 0 for rows that `order` does not have; one more, which is 0
const NEAR = 0.01;
const BLUR = 0.3;
const LEAST_SHARE = 2.5e-5;

@group(1) @binding(1) var<storage, read> order: array<u32>;
@group(1) @binding(2) var<storage, read> solids: array<vec4f>;
@group(1) @binding(3) var<storage, read> sh: array<f32>;
@group(1) @binding(4) var<storage, read_write> rows: array<vec4f>;
@group(1) @binding(5) var<storage, read_write> counts: array<u32>;

fn write(at: u32, tile: u32, number: u32) {}

// An upper bound of ln x, at most 1 % above it, for x in 1 to 255.
fn logAbove(x: f32) -> f32 {
    var rest = x;
    var halvings = 0.0;
    while rest > 2.0 {
        rest *= 0.5;
        halvings += 1.0;
    }
    return max(halvings * 0.6931472 + (rest - 1.0) * (rest + 5.0) / (4.0 * rest + 2.0), 0.0);
}

// The columns are the axes of the splat.
fn axesOf(q: vec4f) -> mat3x3f {
    let w = q.x;
    let a = q.y;
    let b = q.z;
    let c = q.w;
    return mat3x3f(
        1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b + w * c), 2.0 * (a * c - w * b),
        2.0 * (a * b - w * c), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c + w * a),
        2.0 * (a * c + w * b), 2.0 * (b * c - w * a), 1.0 - 2.0 * (a * a + b * b),
    );
}

fn colourOf(splat: u32, look: vec3f) -> vec3f {
    var basis = harmonics(look, i32(view.coefficients));
    var sum = vec3f(0.5);
    var at = 3u * view.coefficients * splat;
    for (var k = 0u; k < view.coefficients; k++) {
        sum += basis.f[k] * vec3f(sh[at], sh[at + 1u], sh[at + 2u]);
        at += 3u;
    }
    return max(sum, vec3f(0.0));
}

// Write a row; return the number of its tiles, 0 for a splat that does not reach into the picture.
fn projected(i: u32, splat: u32) -> u32 {
    let solid = solids[3u * splat];
    let scales = solids[3u * splat + 1u].xyz;
    let near = solid.xyz - view.anchor.xyz;
    let turn = view.turn;
    let seen = vec3f(dot(turn[0].xyz, near), dot(turn[1].xyz, near), dot(turn[2].xyz, near))
        + vec3f(turn[0].w, turn[1].w, turn[2].w);
    var opacity = solid.w;
    let z = seen.z;
    if !(z > 0.5 * NEAR) || !(opacity >= SEEN) { return 0u; }  // `order` has the splats beyond NEAR
    let x = seen.x / z;
    let y = seen.y / z;
    let u = view.optics.x / z * (turn[0].xyz - clamp(x, view.limits.x, view.limits.y) * turn[2].xyz);
    let v = view.optics.y / z * (turn[1].xyz - clamp(y, view.limits.z, view.limits.w) * turn[2].xyz);
    let axes = axesOf(solids[3u * splat + 2u]);
    let p = scales * (u * axes);
    let q = scales * (v * axes);
    // The determinant by the cross product of the rows: xx yy - xy xy has no digits left for a thin splat.
    let sides = scales.yzx * scales.zxy * (cross(u, v) * axes);
    let sharp = dot(sides, sides);
    let xx = dot(p, p);
    let xy = dot(p, q);
    let yy = dot(q, q);
    let det = sharp + BLUR * (xx + yy) + BLUR * BLUR;
    if view.antialiased != 0u {
        opacity *= sqrt(max(LEAST_SHARE, sharp / det));
        if !(opacity >= SEEN) { return 0u; }
    }
    let reach = 2.0 * logAbove(255.0 * opacity);
    let half = sqrt(reach * vec2f(xx + BLUR, yy + BLUR));
    let place = view.optics.xy * vec2f(x, y) + view.optics.zw;
    if !(all(place + half > view.bounds.xy) && all(place - half < view.bounds.zw)) { return 0u; }
    let whole = floor(place);
    let rest = place - whole;
    let colour = colourOf(splat, normalize(near + view.away.xyz));
    let row = Row(
        vec4f(whole.x, rest.x, whole.y, rest.y),
        vec4f(vec3f(yy + BLUR, -xy, xx + BLUR) / det, opacity),
        vec4f(colour, z),
        vec4f(reach, 1.0 / det, half),
    );
    rows[4u * i] = row.place;
    rows[4u * i + 1u] = row.form;
    rows[4u * i + 2u] = row.shade;
    rows[4u * i + 3u] = row.reach;
    return visit(row, i, 0u, 0u);
}

@compute @workgroup_size(64)
fn project(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let i = threadOf(id, groups);
    var own = 0u;
    if i < view.count { own = projected(i, order[i]); }
    if i <= view.total { counts[i] = own; }
}
