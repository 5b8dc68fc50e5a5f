"""Compact MJCF models to measure rigid bodies with: ant, hopper, hand with a cube, humanoid.

The same degrees of freedom, contacts and constraint rows as in the study of MJX that the rigid core began from:

            dofs  contacts  rows
  ant         14         9    44
  hopper       6         6    27
  hand        22         8    48
  humanoid    27        14    77
"""

import dataclasses
import math
from collections.abc import Callable

from rewax.physics.rigid import Penalty


@dataclasses.dataclass(frozen=True)
class Contact:
    """Substep and contact parameters; by default MuJoCo's, whose gradients are the hardest."""

    dt: float = 1 / 120
    iterations: int = 4
    solref: str = "0.02 1"
    solimp: str = "0.9 0.95 0.001 0.5 2"

    def wrap(self, angle: str, world: str, actuators: str, pairs: list[tuple[str, str]]) -> str:
        law = f'condim="3" solref="{self.solref}" solimp="{self.solimp}"'
        touching = "".join(f'<pair geom1="{a}" geom2="{b}"/>' for a, b in pairs)
        return f"""<mujoco><compiler angle="{angle}"/>
        <option timestep="{self.dt!r}" solver="Newton" iterations="{self.iterations}" ls_iterations="8" tolerance="1e-8"
          cone="pyramidal" integrator="Euler"/>
        <default><geom contype="0" conaffinity="0" density="1000"/>
          <pair {law} friction="1 1 0.005 0.0001 0.0001"/></default>
        <worldbody>{world}</worldbody><actuator>{actuators}</actuator><contact>{touching}</contact></mujoco>"""


FLOOR = '<geom name="floor" type="plane" size="40 40 1"/>'


def motor(joint: str, gear: float) -> str:
    return f'<motor joint="{joint}" gear="{gear:g}" ctrlrange="-1 1" ctrllimited="true"/>'


def ant(contact: Contact) -> str:
    """A torso on four legs of two hinges each; shins (capsules) and torso touch the floor."""
    legs, motors = "", ""
    for i in range(4):
        c, s = math.cos(math.pi / 4 + i * math.pi / 2), math.sin(math.pi / 4 + i * math.pi / 2)
        hip, shin = f"{0.2 * c:.4f} {0.2 * s:.4f} 0", f"{0.4 * c:.4f} {0.4 * s:.4f} 0"
        drag = 'armature="0.05" damping="1"'
        legs += f"""<body pos="{hip}"><joint name="hip{i}" axis="0 0 1" range="-40 40" {drag}/>
          <geom type="capsule" fromto="0 0 0 {hip}" size="0.08" density="300"/>
          <body pos="{hip}"><joint name="ankle{i}" axis="{-s:.4f} {c:.4f} 0" range="10 90" {drag}/>
            <geom name="shin{i}" type="capsule" fromto="0 0 0 {shin}" size="0.08" density="300"/>
            <geom pos="{shin}" size="0.08" mass="1e-4"/></body></body>"""
        motors += motor(f"hip{i}", 150) + motor(f"ankle{i}", 150)
    torso = '<geom name="torso" size="0.25" density="300"/>'
    world = f'{FLOOR}<body pos="0 0 0.6"><freejoint/>{torso}{legs}</body>'
    return contact.wrap("degree", world, motors, [("floor", f"shin{i}") for i in range(4)] + [("floor", "torso")])


def hopper(contact: Contact) -> str:
    """A leg of three hinges under a torso in a plane; foot, shin and torso touch the floor."""
    drag = 'armature="0.05" damping="1"'
    world = f"""{FLOOR}<body pos="0 0 1.25"><joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1" ref="1.25"/><joint axis="0 1 0"/>
      <geom name="torso" type="capsule" fromto="0 0 .2 0 0 -.2" size="0.05"/>
      <body pos="0 0 -.2"><joint name="thigh" axis="0 -1 0" range="-150 0" {drag}/>
        <geom type="capsule" fromto="0 0 0 0 0 -.45" size="0.05"/>
        <body pos="0 0 -.45"><joint name="leg" axis="0 -1 0" range="-150 0" {drag}/>
          <geom name="leg" type="capsule" fromto="0 0 0 0 0 -.5" size="0.04"/>
          <body pos="0 0 -.5"><joint name="foot" axis="0 -1 0" range="-45 45" {drag}/>
            <geom name="foot" type="capsule" fromto="-.13 0 -.04 .26 0 -.04" size="0.06"/>
    </body></body></body></body>"""
    motors = motor("thigh", 100) + motor("leg", 100) + motor("foot", 50)
    return contact.wrap("degree", world, motors, [("floor", "foot"), ("floor", "torso"), ("floor", "leg")])


def hand(contact: Contact) -> str:
    """Four fingers of four hinges around a cube on the palm, a plane; finger tips (spheres) and palm touch the cube."""
    fingers, motors, pairs = "", "", [("palm", "cube")]
    for i in range(4):
        c, s = math.cos(math.pi / 4 + i * math.pi / 2), math.sin(math.pi / 4 + i * math.pi / 2)
        root, across, inward = f"{0.075 * c:.4f} {0.075 * s:.4f} 0", f"{c:.4f} {s:.4f} 0", f"{s:.4f} {-c:.4f} 0"
        finger = f'<geom name="tip{i}" pos="0 0 .025" size=".0105" density="100"/>'
        for j, (place, axis, limits, length, radius) in (
            (3, ("0 0 .03", inward, "-0.2 1.4", 0.025, 0.010)),
            (2, ("0 0 .035", inward, "-0.2 1.4", 0.03, 0.010)),
            (1, ("0 0 .02", inward, "-0.5 1.4", 0.035, 0.011)),
            (0, (root, across, "-0.5 0.5", 0.02, 0.011)),
        ):
            finger = f"""<body pos="{place}">
              <joint name="joint{i}{j}" axis="{axis}" range="{limits}" armature="0.003" damping="0.05"/>
              <geom type="capsule" fromto="0 0 0 0 0 {length}" size="{radius}" density="800"/>{finger}</body>"""
            motors += f"""<position joint="joint{i}{j}" kp="3" kv="0.1" ctrlrange="-1.5 1.5" ctrllimited="true"
              forcerange="-1 1" forcelimited="true"/>"""
        fingers += finger
        pairs.append((f"tip{i}", "cube"))
    cube = '<geom name="cube" type="box" size=".035 .035 .035" density="400"/>'
    palm = '<geom name="palm" type="plane" size=".3 .3 .1"/>'
    world = f'{palm}{fingers}<body pos="0 0 .036"><freejoint/>{cube}</body>'
    return contact.wrap("radian", world, motors, pairs)


def humanoid(contact: Contact) -> str:
    """Legs of six hinges, arms of three, a waist of three; feet (two capsules each), hands, trunk touch the floor."""

    def hinge(name: str, axis: str, limits: str) -> str:
        return f'<joint name="{name}" axis="{axis}" range="{limits}" armature="0.02" damping="5" stiffness="2"/>'

    legs, arms, motors, pairs = "", "", motor("waist_z", 40) + motor("waist_y", 40) + motor("waist_x", 40), []
    for side, y in (("r", -1), ("l", 1)):
        foot = "".join(
            f"""<geom name="{side}foot{i}" type="capsule" size=".027"
              fromto="-.07 {0.02 * turn * y} -.03 .14 {0.04 * turn * y} -.03"/>"""
            for i, turn in enumerate((1, -1))
        )
        legs += f"""<body pos="0 {0.1 * y} -.04">{hinge(side + "hip_x", "1 0 0", "-25 25")}
          {hinge(side + "hip_z", "0 0 1", "-60 35")}{hinge(side + "hip_y", "0 1 0", "-110 20")}
          <geom type="capsule" fromto="0 0 0 0 {0.01 * y} -.34" size=".06"/>
          <body pos="0 {0.01 * y} -.403">{hinge(side + "knee", "0 1 0", "2 160")}
            <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".049"/>
            <body pos="0 0 -.39">{hinge(side + "foot_y", "0 1 0", "-50 50")}{hinge(side + "foot_x", "1 0 0", "-50 50")}
              {foot}</body></body></body>"""
        arms += f"""<body pos="0 {0.17 * y} .06">{hinge(side + "arm_1", f"2 {-y} 1", "-85 60")}
          {hinge(side + "arm_2", f"0 -1 {-y}", "-85 60")}
          <geom type="capsule" fromto="0 0 0 .16 {0.16 * y} -.16" size=".04"/>
          <body pos=".18 {0.18 * y} -.18">{hinge(side + "elbow", f"0 -1 {y}", "-90 50")}
            <geom type="capsule" fromto="0 0 0 .16 {-0.16 * y} .16" size=".031"/>
            <geom name="{side}hand" pos=".18 {-0.18 * y} .18" size=".04"/></body></body>"""
        gears = {"hip_x": 40, "hip_z": 40, "hip_y": 120, "knee": 80, "foot_y": 20, "foot_x": 20}
        gears |= {"arm_1": 20, "arm_2": 20, "elbow": 40}
        motors += "".join(motor(side + joint, gear) for joint, gear in gears.items())
        pairs += [("floor", f"{side}{part}") for part in ("foot0", "foot1", "hand")]
    world = f"""{FLOOR}<body pos="0 0 1.29"><freejoint/>
      <geom name="torso" type="capsule" fromto="0 -.07 0 0 .07 0" size=".07"/><geom pos="0 0 .19" size=".09"/>{arms}
      <body pos="-.01 0 -.26">{hinge("waist_z", "0 0 1", "-45 45")}{hinge("waist_y", "0 1 0", "-75 30")}
        <geom type="capsule" fromto="0 -.06 0 0 .06 0" size=".06"/>
        <body pos="0 0 -.165">{hinge("waist_x", "1 0 0", "-35 35")}
          <geom name="pelvis" type="capsule" fromto="-.02 -.07 0 -.02 .07 0" size=".09"/>{legs}</body></body></body>"""
    return contact.wrap("degree", world, motors, [*pairs, ("floor", "torso"), ("floor", "pelvis")])


MODELS: dict[str, Callable[[Contact], str]] = {"ant": ant, "hopper": hopper, "hand": hand, "humanoid": humanoid}

RESTING = {"ant": 10.0, "hopper": 3.0, "hand": 0.1, "humanoid": 10.0}
"""Mass that rests on a contact [kg], to which its spring is fitted."""


def penalty_of(name: str) -> Penalty:
    """Springs and dampers for a model's weight: 5 mm deep at rest."""
    mass = RESTING[name]
    return Penalty(
        stiffness=1800.0 * mass,
        damping=34.0 * mass,
        friction_damping=22.0 * mass,
        onset=0.01,
        limit_stiffness=25.0 * mass,
        limit_damping=0.5 * mass,
    )
