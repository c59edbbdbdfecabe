// The pixels of a view, and their rays. WGSL. Paste view.wgsl above this file.
//
//   pixels  for each pixel its number in the picture; red, green, blue and alpha as four unorm16 in two words; and as
//           float32 the distance of the surface that pictures show, 0 if it is not known
//   bent    if a lens bends the rays: three float32 for each ray of the whole picture, a direction in the camera's axes
//   rays    what each ray has seen: its colour over the background, and the share of the light that goes through; then,
//           for the distortion loss, three more: the sums of weight times depth, of weight times slope, and of weight
//           times what the depth loss counts
//   residuals  of each pixel in colour and alpha, after their limits
@group(2) @binding(0) var<storage, read> pixels: array<u32>;
@group(2) @binding(1) var<storage, read> bent: array<f32>;
@group(1) @binding(5) var<storage, read_write> rays: array<vec4f>;
@group(1) @binding(6) var<storage, read_write> residuals: array<vec4f>;

// The colour that a pixel should have, and its alpha.
fn targetOf(pixel: u32) -> vec4f {
    let colour = vec4f(unpack2x16unorm(pixels[4u * pixel + 1u]), unpack2x16unorm(pixels[4u * pixel + 2u]));
    let ground = (1.0 - colour.a) * view.background.rgb;
    return vec4f((colour.rgb - ground) / view.gains.rgb + ground, colour.a);
}

// The unit direction of a ray in the world; its pixels' rays are numbered row by row.
fn directionOf(pixel: u32, ray: u32) -> vec3f {
    let number = pixels[4u * pixel];
    var look: vec3f;
    if (view.flags & BENT) != 0u {
        let at = 3u * (number * view.samples * view.samples + ray);
        look = vec3f(bent[at], bent[at + 1u], bent[at + 2u]);
    } else {
        let corner = vec2f(f32(number % view.width), f32(number / view.width));
        let within = (vec2f(f32(ray % view.samples), f32(ray / view.samples)) + 0.5) / f32(view.samples);
        let moved = within + view.tilt * vec2f(within.y - 0.5, 0.5 - within.x);
        let slope = (corner + moved - view.optics.zw) / view.optics.xy;
        look = vec3f(slope.x, -slope.y, -1.0);
    }
    return normalize(vec3f(dot(view.turn[0].xyz, look), dot(view.turn[1].xyz, look), dot(view.turn[2].xyz, look)));
}
