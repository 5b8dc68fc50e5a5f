"""MJCF models that several tests of rigid bodies share, as text."""

import math

SOFT = 'solref="0.02 1" solimp="0.0001 0.95 0.02 0.5 2"'
"""Contact whose impedance begins at zero: the only kind whose gradient sees when it begins."""


def mjcf(
    world: str,
    *,
    extra: str = "",
    dt: float = 1 / 240,
    contact: str = SOFT,
    medium: str = "",
    gravity: str = "0 0 -9.81",
) -> str:
    """A model with the solver of C MuJoCo run to convergence, so that its result can be compared with."""
    return f"""<mujoco><compiler angle="radian" autolimits="true"/>
    <option timestep="{dt!r}" gravity="{gravity}" solver="Newton" cone="pyramidal" integrator="Euler" iterations="50"
      ls_iterations="50" tolerance="1e-14" ls_tolerance="1e-10" {medium}/>
    <default><geom contype="0" conaffinity="0" friction="0.8 0.005 0.0001" {contact}/>
      <pair friction="0.8 0.8 0.005 0.0001 0.0001" {contact}/></default>
    <worldbody>{world}</worldbody>{extra}</mujoco>"""


FLOOR = '<geom name="floor" type="plane" size="9 9 1"/>'


def touching(*pairs: tuple[str, str]) -> str:
    """These geoms collide, no others."""
    return "<contact>" + "".join(f'<pair geom1="{a}" geom2="{b}"/>' for a, b in pairs) + "</contact>"


def motors(**gears: float) -> str:
    inner = "".join(f'<motor name="{j}" joint="{j}" gear="{g}" ctrlrange="-1 1"/>' for j, g in gears.items())
    return f"<actuator>{inner}</actuator>"


def pendulum(num: int = 2, **options: str) -> str:
    """Rods of 1 m that hang one on another on hinges without friction, the first one on the world."""
    body = ""
    for i in range(num):
        place = "" if i == num - 1 else 'pos="0 0 -1"'
        body = f"""<body {place}><joint name="turn{num - 1 - i}" type="hinge" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.04"/>{body}</body>"""
    return mjcf(body.replace('pos="0 0 -1"', "", 1) if num > 1 else body, **options)


def ball(**options: str) -> str:
    world = FLOOR + '<body name="ball" pos="0 0 0.3"><freejoint/><geom name="ball" size="0.1" density="300"/></body>'
    return mjcf(world, extra=touching(("floor", "ball")), **options)


def capsule(**options: str) -> str:
    shape = '<geom name="rod" type="capsule" size="0.05 0.2" density="500"/>'
    world = FLOOR + f'<body name="rod" pos="0 0 0.3"><freejoint/>{shape}</body>'
    return mjcf(world, extra=touching(("floor", "rod")), **options)


def pushed_box(**options: str) -> str:
    """A ball on a motor along x before a box that lies on the floor."""
    world = f"""{FLOOR}
    <body name="box" pos="0 0 0.1"><freejoint/><geom name="box" type="box" size="0.1 0.12 0.1" density="300"/></body>
    <body pos="-0.2 0.03 0.1"><joint name="push" type="slide" axis="1 0 0" damping="1"/>
      <geom name="hand" size="0.1" density="300"/></body>"""
    return mjcf(world, extra=touching(("floor", "box"), ("hand", "box")) + motors(push=30), **options)


def box_on_box(**options: str) -> str:
    """A free box on one that is fixed."""
    world = """<geom name="below" type="box" size="0.2 0.25 0.1"/>
    <body name="box" pos="0.05 0.03 0.2"><freejoint/><geom name="box" type="box" size="0.1 0.12 0.1" density="300"/></body>"""
    return mjcf(world, extra=touching(("below", "box")), **options)


def hopper(**options: str) -> str:
    """One leg in a plane: trunk, thigh, shin and foot."""
    joint = 'type="hinge" axis="0 -1 0" armature="0.05" damping="1"'
    world = f"""{FLOOR}
    <body name="trunk" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="tilt" type="hinge" axis="0 1 0"/>
      <geom name="trunk" type="capsule" fromto="0 0 0 0 0 .4" size=".06"/>
      <body><joint name="hip" {joint} range="-1.6 0.6"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".05"/>
        <body pos="0 0 -.4"><joint name="knee" {joint} range="-2 0.1"/>
          <geom name="shin" type="capsule" fromto="0 0 0 0 0 -.45" size=".04"/>
          <body name="foot" pos="0 0 -.45"><joint name="ankle" {joint} range="-0.8 0.8"/>
            <geom name="foot" type="capsule" fromto="-.1 0 -.05 .2 0 -.05" size=".05"/></body></body></body></body>"""
    pairs = touching(*(("floor", geom) for geom in ("trunk", "shin", "foot")))
    return mjcf(world, extra=motors(hip=80, knee=80, ankle=40) + pairs, **options)


def ant(**options: str) -> str:
    """A trunk with four legs of two hinges, whose shins never stand upright: then MJX turns the directions of friction."""
    legs, gears, pairs = "", {}, [("floor", "trunk")]
    for i in range(4):
        x, y = math.cos(math.pi * (i + 0.5) / 2), math.sin(math.pi * (i + 0.5) / 2)
        joint = 'type="hinge" armature="0.04" damping="0.8"'
        legs += f"""<body pos="{0.2 * x} {0.2 * y} 0"><joint name="hip{i}" {joint} axis="0 0 1" range="-0.6 0.6"/>
          <geom type="capsule" fromto="0 0 0 {0.2 * x} {0.2 * y} 0" size=".07" density="400"/>
          <body pos="{0.2 * x} {0.2 * y} 0"><joint name="knee{i}" {joint} axis="{-y} {x} 0" range="0.2 0.9"/>
            <geom name="shin{i}" type="capsule" fromto="0 0 0 {0.4 * x} {0.4 * y} 0" size=".07" density="400"/></body></body>"""
        gears |= {f"hip{i}": 90, f"knee{i}": 90}
        pairs.append(("floor", f"shin{i}"))
    world = f"""{FLOOR}<body name="trunk" pos="0 0 0.5"><freejoint/>
      <geom name="trunk" size=".22" density="400"/>{legs}</body>"""
    return mjcf(world, extra=motors(**gears) + touching(*pairs), **options)


def hand(**options: str) -> str:
    """Four fingers of four hinges with balls at their tips around a cube that only the tips touch."""
    fingers, servos = "", ""
    for i in range(4):
        x, y = math.cos(math.pi * i / 2), math.sin(math.pi * i / 2)
        inward, around = f"{y} {-x} 0", f"{x} {y} 0"
        finger = f'<geom name="tip{i}" pos="0 0 .03" size=".012" density="600"/>'
        for j in range(4):
            joint = f'name="j{i}{3 - j}" type="hinge" axis="{around if j == 3 else inward}" range="-0.6 1.4"'
            bone = '<geom type="capsule" fromto="0 0 0 0 0 .03" size=".01" density="800"/>'
            place = f"{0.07 * x} {0.07 * y} 0" if j == 3 else "0 0 .03"
            finger = f'<body pos="{place}"><joint {joint} armature="0.002" damping="0.03"/>{bone}{finger}</body>'
            servos += f'<position joint="j{i}{j}" kp="2" kv="0.05" ctrlrange="-1.4 1.4" forcerange="-0.8 0.8"/>'
        fingers += finger
    cube = '<geom name="cube" type="box" size=".04 .04 .04" density="300"/>'
    world = f'{fingers}<body name="cube" pos="0 0 0.1"><freejoint/>{cube}</body>'
    extra = f"<actuator>{servos}</actuator>" + touching(*((f"tip{i}", "cube") for i in range(4)))
    return mjcf(world, extra=extra, **options)


def contraption(**options: str) -> str:
    """A bit of everything that is supported.

    Kinds of joints, springs, dampers, dry friction, limits, equalities, tendons, kinds of actuators and of activations,
    weights held up, a medium that drags; contacts of several shapes, frictions, condim and margins, by pairs and not.
    In its keyframe springs are strained and limits passed, and all but bulb and stone touch. Masses of free bodies lie
    beside their frames, and the capsule on the floor lies: of one that stands MJX turns the two directions of friction.
    """
    world = """<geom name="floor" type="plane" size="9 9 1" contype="1" conaffinity="1"/>
    <geom name="shelf" type="box" pos=".7 .5 .3" size=".1 .1 .05" quat="1 .05 .02 0"/>
    <site name="hook" pos="0 .4 1"/>
    <body name="cart" pos="0 0 .5">
      <joint name="x" type="slide" axis="1 .2 0" damping="2" frictionloss="1.5" armature=".1"/>
      <geom type="box" size=".1 .08 .06"/><site name="eye" pos=".05 0 .05"/>
      <body name="arm" pos="0 0 .1" quat="1 .1 .2 .3" gravcomp=".4">
        <joint name="h" type="hinge" axis="0 1 .1" pos="0 0 -.02" stiffness="3" springref=".4" damping=".3" range="-1.5 .35"
          margin=".05" ref=".2" solimplimit=".5 .9 .1 .5 2"/>
        <geom type="capsule" fromto="0 0 0 .1 0 .3" size=".03"/>
        <body pos=".1 0 .3">
          <joint name="k" type="hinge" axis="0 1 0" frictionloss=".1" damping=".05" actuatorfrcrange="-3 3"/>
          <geom type="capsule" fromto="0 0 0 .25 0 0" size=".025"/><site name="tip" pos=".25 0 0"/>
          <body pos=".25 0 0"><joint name="w" type="hinge" axis="1 0 1" damping=".1" armature=".01"/>
            <geom size=".04 .05 .06" type="box"/></body></body></body></body>
    <body name="lamp" pos="-.6 0 .253">
      <joint name="swing" type="ball" pos="0 0 .3" damping=".05" stiffness=".4" range="0 .6" margin=".02"
        solimplimit=".5 .9 .1 .5 2"/>
      <geom type="capsule" fromto="0 0 .3 0 0 0" size=".02"/>
      <geom name="bulb" size=".08" contype="1" conaffinity="1"/></body>
    <body name="stone" pos="-.55 .1 .085"><freejoint/>
      <geom name="stone" type="capsule" pos="0 .006 .01" size=".09 .07" contype="1" conaffinity="1" condim="4" margin=".01"
        friction=".6 .02 .01" solmix="2"/></body>
    <body name="puck" pos=".7 -.2 .078"><freejoint/><geom name="puck" pos=".005 0 .004" size=".08"/></body>
    <body name="bead" pos=".7 .5 .395"><freejoint/><geom name="bead" pos="0 .004 .002" size=".05"/></body>
    <body name="rod" pos="0 .4 .9"><freejoint/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body>"""
    extra = """<tendon>
      <fixed name="coupling" stiffness="2" damping=".1" range="-2 .1" frictionloss=".02">
        <joint joint="h" coef="1"/><joint joint="k" coef="-.6"/></fixed>
      <spatial name="rope" stiffness="30" damping="1" springlength=".3 .5"><site site="hook"/><site site="eye"/></spatial>
    </tendon>
    <equality><joint joint1="w" joint2="k" polycoef=".1 .5 .2 0 0"/>
      <connect body1="rod" body2="world" anchor="0 0 .1"/></equality>
    <actuator><motor name="drive" joint="x" gear="5" ctrlrange="-1 1"/>
      <position name="servo" joint="h" kp="6" kv=".3" forcerange="-1.5 1.5" ctrlrange="-.5 .5"/>
      <velocity name="brake" joint="k" kv=".2" ctrlrange="-2 2"/>
      <general name="slow" joint="k" dyntype="filter" dynprm=".08" gainprm="2" ctrlrange="-1 1"/>
      <general name="exact" joint="swing" gear=".3 .1 .2" dyntype="filterexact" dynprm=".05" ctrlrange="-1 1"/>
      <intvelocity name="turn" joint="w" kp=".5" actrange="-.02 .02" ctrlrange="-3 3"/>
      <motor name="winch" tendon="coupling" gear=".4" ctrlrange="-1 1"/>
      <motor name="jet" site="tip" gear="0 0 1 .1 0 0" ctrlrange="-1 1"/>
      <muscle name="muscle" joint="h" lengthrange="-.6 .8" force="3" ctrlrange="0 1"/></actuator>
    <contact><pair geom1="floor" geom2="puck" condim="3" friction=".3 .5 .01 .01 .01" margin=".005"/>
      <pair geom1="shelf" geom2="bead" condim="1"/></contact>
    <keyframe><key qpos=".05 .34 .1 -.2  .94 .1 .32 .02  -.55 .1 .085 .72 .02 .69 0  .7 -.2 .078 1 0 0 0
      .7 .5 .395 1 0 0 0  0 .4 .9 1 .1 0 0"/></keyframe>"""
    return mjcf(world, extra=extra, medium='density="1.2" viscosity="0.3" wind=".5 0 0"', **options)


__all__ = [name for name in dir() if not name.startswith("_") and name != "math"]
