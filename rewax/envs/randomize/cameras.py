"""Draws of a camera's pose and field of view, in metres and radians."""

from rewax.envs.randomize.distributions import Distribution, Per, Scale, Shift, Turn, Uniform


def camera(
    name: str, *, position: float = 0.0, rotation: float = 0.0, zoom: float = 0.0
) -> dict[str, Distribution | Scale | Shift | Turn]:
    """Draws that move a camera a little, for ``hook``: a real camera is never mounted exactly as designed.

    Args:
      name: of the camera among the parameters, as ``leaves`` lists them: ``"sensors[depth]"``,
        ``"sensors[cloud].camera"``, ``"env.sensors[depth]"`` inside of one wrapper.
      position: each coordinate is shifted by up to this much [m].
      rotation: the camera is turned by up to this much about each of its axes [rad].
      zoom: the focal length is multiplied by up to 1 + zoom and at least 1 - zoom [-], below 0.5. It needs
        ``Camera(zoom=1.0)``.

    Returns:
      Uniform draws by name of parameter. Those of 0 are left out. Draws of noise stand beside them:
      ``"sensors[depth].noise.constant": Uniform(0.0, 0.004)``.

    Raises:
      ValueError: an amount is negative or not finite, zoom is not below 0.5, or all amounts are 0.

    Example:
      >>> moved = hook(camera("sensors[depth]", position=0.01, rotation=0.03))
      >>> agent = make_sapo(Sensing(env=env, sensors={"depth": depth}), config, randomize=moved)  # doctest: +SKIP
    """
    for what, amount in (("position", position), ("rotation", rotation), ("zoom", zoom)):
        if not 0.0 <= amount < (0.5 if what == "zoom" else float("inf")):
            raise ValueError(f"{what} of {name} is {amount}: give a number from 0 on{', below 0.5' * (what == 'zoom')}")
    draws: dict[str, Distribution | Scale | Shift | Turn] = {}
    if position:
        draws[f"{name}.position"] = Shift(Uniform(-position, position, per=Per.ELEMENT))
    if rotation:
        draws[f"{name}.rotation"] = Turn(Uniform(-rotation, rotation))
    if zoom:
        draws[f"{name}.zoom"] = Scale(Uniform(1.0 - zoom, 1.0 + zoom))
    if not draws:
        raise ValueError(f"nothing of {name} is drawn: give position, rotation or zoom")
    return draws


__all__ = ["camera"]
