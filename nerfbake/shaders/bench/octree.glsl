// The row at a voxel by the way down from an octree's root, a fetch a level: what the lookup of page/field.glsl is
// measured against, in whose place it stands (nerfbake/bench/view/octree.py).
//
//   blocks  two texels a node: its children 4 x + 2 y + z; the number of a node, -1 for empty space, -2 - row for a leaf
//   START   where the page's grid starts in the octree, in voxels
//   HEIGHT  levels below the root
int look(ivec3 voxel, out ivec3 corner, out int edge) {
  ivec3 at = voxel + START;
  int node = 0;
  for (int shift = HEIGHT - 1; ; shift--) {
    ivec3 side = at >> shift & 1;
    int number = 2 * node + side.x;
    uvec4 children = texelFetch(blocks, ivec2(number & (1 << blockBits) - 1, number >> blockBits), 0);
    uvec2 pair = side.y > 0 ? children.zw : children.xy;
    int child = int(side.z > 0 ? pair.y : pair.x);
    if (child < 0 || shift == 0) {
      corner = (at >> shift << shift) - START;
      edge = 1 << shift;
      return child < -1 ? -2 - child : -1;
    }
    node = child;
  }
}
