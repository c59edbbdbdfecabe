using System;
using System.Collections.Generic;

// What the package uses of Unity and NUnit, as their manuals declare it, with as little behind it as its own tests need:
// whether the package's scripts fit together, not whether Unity does what it says.
namespace UnityEngine
{
    [Flags]
    public enum DepthTextureMode { None = 0, Depth = 1 }
    public enum HideFlags { None = 0, DontSave = 52 }
    public enum FilterMode { Point, Bilinear, Trilinear }
    public enum TextureWrapMode { Repeat, Clamp }
    public enum PrimitiveType { Sphere, Capsule, Cylinder, Cube, Plane, Quad }

    public class Object
    {
        public string name { get; set; }
        public HideFlags hideFlags { get; set; }
        public static void DestroyImmediate(Object found) { }
    }

    public class ScriptableObject : Object
    {
        public static T CreateInstance<T>() where T : ScriptableObject { return Activator.CreateInstance<T>(); }
    }

    public class Component : Object
    {
        public Transform transform { get { return null; } }
        public T GetComponent<T>() { return default(T); }
    }

    public class Behaviour : Component
    {
        public bool isActiveAndEnabled { get { return true; } }
    }

    public class MonoBehaviour : Behaviour { }

    public class Transform : Component
    {
        public Vector3 position { get; set; }
        public Vector3 localScale { get; set; }
    }

    public sealed class GameObject : Object
    {
        public GameObject(string name, params Type[] components) { }
        public Transform transform { get { return null; } }
        public T GetComponent<T>() { return default(T); }
        public static GameObject CreatePrimitive(PrimitiveType type) { return null; }
    }

    public sealed class Camera : Behaviour
    {
        public static Camera current { get { return null; } }
        public DepthTextureMode depthTextureMode { get; set; }
    }

    public class Renderer : Component
    {
        public Bounds bounds { get { return new Bounds(); } }
        public Material sharedMaterial { get; set; }
        public void SetPropertyBlock(MaterialPropertyBlock properties) { }
    }

    public sealed class MeshRenderer : Renderer { }

    public sealed class MeshFilter : Component
    {
        public Mesh sharedMesh { get; set; }
    }

    public sealed class Mesh : Object
    {
        public Vector3[] vertices { get; set; }
        public int[] triangles { get; set; }
        public Rendering.IndexFormat indexFormat { get; set; }
        public void RecalculateBounds() { }
    }

    public class Texture : Object { }

    public sealed class Texture2D : Texture
    {
        public int width { get { return 0; } }
        public int height { get { return 0; } }
        public Color32[] GetPixels32() { return null; }
        public void SetPixels32(Color32[] colors) { }
        public void Apply(bool updateMipmaps) { }
    }

    public class TextAsset : Object
    {
        public string text { get { return ""; } }
    }

    public class Material : Object
    {
        public Material(Shader shader) { }
        public void EnableKeyword(string keyword) { }
        public void DisableKeyword(string keyword) { }
        public void SetVector(string name, Vector4 value) { }
        public void SetFloat(string name, float value) { }
        public void SetTexture(string name, Texture value) { }
    }

    public sealed class MaterialPropertyBlock
    {
        public void SetBuffer(int nameID, ComputeBuffer value) { }
        public void SetVector(int nameID, Vector4 value) { }
    }

    public sealed class ComputeBuffer
    {
        public ComputeBuffer(int count, int stride) { }
        public void SetData(Array data) { }
        public void Release() { }
    }

    public sealed class Shader : Object
    {
        public static int PropertyToID(string name) { return name.GetHashCode(); }
        public static Shader Find(string name) { return null; }
    }

    public static class JsonUtility
    {
        public static T FromJson<T>(string json) { return default(T); }
    }

    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public static Vector3 one { get { return new Vector3(1, 1, 1); } }
        public static Vector3 right { get { return new Vector3(1, 0, 0); } }
        public float magnitude { get { return (float)Math.Sqrt(x * x + y * y + z * z); } }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
        public static Vector3 operator *(float a, Vector3 b) { return new Vector3(a * b.x, a * b.y, a * b.z); }
    }

    public struct Vector4
    {
        public float x, y, z, w;
        public Vector4(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
    }

    public struct Bounds
    {
        public Vector3 center { get; set; }
        public Vector3 size { get; set; }
        public Vector3 extents { get; set; }
        public Vector3 min { get; set; }
    }

    public struct Color32
    {
        public byte r, g, b, a;
    }

    public sealed class SerializeField : Attribute { }
    public sealed class HideInInspector : Attribute { }
    public sealed class ExecuteAlways : Attribute { }

    public sealed class TooltipAttribute : Attribute
    {
        public TooltipAttribute(string tooltip) { }
    }

    public sealed class RequireComponent : Attribute
    {
        public RequireComponent(Type requiredComponent) { }
        public RequireComponent(Type requiredComponent, Type requiredComponent2) { }
    }
}

namespace UnityEngine.Rendering
{
    public enum IndexFormat { UInt16, UInt32 }
}

namespace UnityEditor
{
    public enum TextureImporterNPOTScale { None, ToNearest }
    public enum TextureImporterCompression { Uncompressed, Compressed }

    public class AssetImporter : UnityEngine.Object { }

    public class AssetPostprocessor
    {
        public string assetPath { get; set; }
        public AssetImporter assetImporter { get { return null; } }
    }

    public sealed class TextureImporter : AssetImporter
    {
        public bool sRGBTexture { get; set; }
        public bool mipmapEnabled { get; set; }
        public int maxTextureSize { get; set; }
        public TextureImporterNPOTScale npotScale { get; set; }
        public TextureImporterCompression textureCompression { get; set; }
        public UnityEngine.FilterMode filterMode { get; set; }
        public UnityEngine.TextureWrapMode wrapMode { get; set; }
    }
}

namespace UnityEditor.AssetImporters
{
    public sealed class ScriptedImporterAttribute : Attribute
    {
        public ScriptedImporterAttribute(int version, string ext) { }
    }

    public abstract class ScriptedImporter : AssetImporter
    {
        public abstract void OnImportAsset(AssetImportContext ctx);
    }

    public sealed class AssetImportContext
    {
        public readonly List<string> Errors = new List<string>();
        public string assetPath { get; set; }
        public UnityEngine.Object mainObject { get; private set; }
        public void AddObjectToAsset(string identifier, UnityEngine.Object obj) { }
        public void SetMainObject(UnityEngine.Object obj) { mainObject = obj; }
        public void LogImportError(string msg) { Errors.Add(msg); }
    }
}

namespace NUnit.Framework
{
    public sealed class TestAttribute : Attribute { }

    public static class Assert
    {
        public static void AreEqual(object expected, object actual)
        {
            if (!expected.Equals(actual))
                throw new Exception("expected " + expected + ", found " + actual);
        }

        public static void Throws<T>(Action code) where T : Exception
        {
            try
            {
                code();
            }
            catch (T)
            {
                return;
            }
            throw new Exception("nothing was thrown");
        }
    }
}
