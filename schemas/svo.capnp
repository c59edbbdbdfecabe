# The sparse voxel octree of TR-24-01 (docs/sources.md) as a Cap'n Proto struct. How it may change: README.md.
#
# Fields mean what they mean in svo.proto. A file has either nodeChildren and nodeData (the `report` profile) or
# childrenBlob and dataBlob (`bulk`).
@0xb7c2f1d0a5e94c36;

struct Array @0xc3a1d2e4f5061728 {
  # An array as its little-endian bytes, C order; dtype as NumPy spells it: <i4, <f4, <f2.
  dtype @0 :Text;
  shape @1 :List(UInt64);
  data @2 :Data;
}

struct SparseVoxelOctree @0xd4b2c3a596871605 {
  typeUrl @0 :Text;
  width @1 :Int32;
  height @2 :Int32;
  depth @3 :Int32;
  nodeChildren @4 :List(Int32);
  nodeData @5 :List(Float32);
  dataFormat @6 :Text;
  dataDim @7 :Int32;
  levelSizes @8 :List(Int32);
  origin @9 :List(Float64);
  voxelSize @10 :List(Float64);
  extraData @11 :List(Float32);
  childrenBlob @12 :Array;
  dataBlob @13 :Array;
}
