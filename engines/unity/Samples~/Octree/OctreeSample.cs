using Nerfbake;
using UnityEngine;

/// <summary>
/// An octree among ordinary meshes. Add this to an empty object, assign an imported .svo.pb and press play. A plane and
/// a ball hide parts of the octree and are partly hidden by it, and the octree's shadow falls on the plane.
/// </summary>
public sealed class OctreeSample : MonoBehaviour
{
    [SerializeField] private OctreeAsset octree;
    [SerializeField] private bool cutout;

    private void Start()
    {
        GameObject field = new GameObject("octree", typeof(MeshFilter), typeof(MeshRenderer), typeof(OctreeRenderer));
        Shader shader = Shader.Find(cutout ? "Nerfbake/Octree Cutout" : "Nerfbake/Octree");
        field.GetComponent<MeshRenderer>().sharedMaterial = new Material(shader);
        field.GetComponent<OctreeRenderer>().Octree = octree;
        Bounds bounds = field.GetComponent<MeshRenderer>().bounds;

        GameObject plane = GameObject.CreatePrimitive(PrimitiveType.Plane);
        plane.transform.position = new Vector3(bounds.center.x, bounds.min.y, bounds.center.z);
        plane.transform.localScale = 0.3f * bounds.size.magnitude * Vector3.one;
        GameObject ball = GameObject.CreatePrimitive(PrimitiveType.Sphere);
        ball.transform.position = bounds.center + 0.5f * bounds.extents.x * Vector3.right;
        ball.transform.localScale = 0.3f * bounds.size.y * Vector3.one;
    }
}
