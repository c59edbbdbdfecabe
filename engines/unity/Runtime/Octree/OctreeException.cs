using System;

namespace Nerfbake
{
    /// <summary>Describes an invalid file in one line: the place, what was found, and what is allowed.</summary>
    public sealed class OctreeException : Exception
    {
        public OctreeException(string place, string found, string allowed)
            : base(place + " " + found + "; allowed: " + allowed)
        {
        }
    }
}
