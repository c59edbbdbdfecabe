"""What every scene that a file can hold answers: is it sound, and what is wrong with it?"""

from __future__ import annotations

from nerfbake.errors import InvalidScene, Problem


class Scene:
    """Shapes and dtypes are checked as a scene is made; a structure or values that cannot be right are told here."""

    def structure_problems(self) -> list[Problem]:
        """What keeps the scene from being read at all."""
        return []

    def value_problems(self) -> list[Problem]:
        """Values that nobody can use; the structure must be sound."""
        return []

    def problems(self) -> list[Problem]:
        """Everything that is wrong; values are looked at once the structure is sound."""
        return self.structure_problems() or self.value_problems()

    def require_sound(self) -> None:
        """Raises InvalidScene with the first structural problem, if there is one."""
        if problems := self.structure_problems():
            raise InvalidScene(problems[0])
