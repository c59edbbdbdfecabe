// The row at a voxel, found by traversing an octree from its root with one fetch per level. benchmarks/view.py puts
// this function in place of look() in nerfbake/shaders/page/field.glsl, to compare the two.
//
//   blocks  two texels per node: its children 4 x + 2 y + z; each is the number of a node, -1 for empty space, or -2 -
//           row for a leaf
//   START   first voxel of the page's grid in the octree
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
