// The shadow of a field. Seen from the light, the share of pixels that are drawn is the field's opacity; their depth is
// the expected end of their rays. The pattern is Jimenez' interleaved gradient noise (2014), which a filtered shadow
// map smooths.
#include "Octree.hlsl"

float caster(Hull hull) : SV_Depth {
    Ray ray = rayTo(hull.world);
    OctreeRay found = marched(ray, 1e30);
    float noise = frac(52.9829189 * frac(dot(hull.position.xy, float2(0.06711056, 0.00583715))));
    clip(1.0 - found.transmittance - max(noise, 1e-3));
    return depthOf(ray.origin + found.depth * ray.along);
}
