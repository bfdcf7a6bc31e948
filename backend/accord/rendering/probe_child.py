"""One frame of a red ball, in a process of its own: `python -m accord.rendering.probe_child`."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco

from accord.rendering.probe import DREW

BALL = """
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody><geom type="sphere" size="1" rgba="1 0 0 1"/></worldbody>
</mujoco>
"""


def main() -> None:
    """Print that a frame was drawn, or what came instead of red."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data)
        red, green, blue = (int(channel) for channel in renderer.render()[16, 16])
    if red > 200 and green < 50 and blue < 50:
        print(DREW, flush=True)
    else:
        raise SystemExit(f"a red ball came out as ({red}, {green}, {blue})")


if __name__ == "__main__":
    main()
