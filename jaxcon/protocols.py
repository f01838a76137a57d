# pyright: strict
"""The protocols of the parts of a simulation. Read this file first.

`step.py` and the layers around it know the parts of a scene and of a method by these protocols:

    System           a mechanical model: M, f, the kinematics of q, and the constraints
    Constraint       a group of equality constraints of one kind: φ, φ̇, J and γ
    InequalityGroup  a group of limits, contacts or motors of one kind
    Stabilizer       b and C of J a + C λ = b, and the correction after a step
    Integrator       the next q and v from accelerations
    Solver           a and λ of M a = f + Jᵀλ, J a + C λ = b
    ContactSolver    the multipliers of inequality constraints
    Adjoint          the states that the reverse pass of a rollout keeps

To write a part, inherit from its protocol. Methods marked `@abstractmethod` and fields without a
value are required; all other methods have a default. `System` is the exception: a new system needs
all methods of `System`, and also those of `Bodies` if it consists of bodies.
Parts are pytrees (`core.pytree`), so that their numbers can be traced, batched and differentiated.
Docstrings give the shapes of arrays in one world; a batch of worlds adds one axis at the end.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Hashable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from jaxcon.core.typing import Array, DType, Number, PyTree, Scalar, TreeNode

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import Row
    from jaxcon.constraints.rows import Rows
    from jaxcon.contact.bounded import Bounded
    from jaxcon.contact.rows import BoundSet
    from jaxcon.core.doubled import Doubled
    from jaxcon.core.lanes import Vector
    from jaxcon.execution.adjoints import Path
    from jaxcon.linear.jacobian import Columns
    from jaxcon.linear.saddle import Factored, Mass, Saddle, Solution
    from jaxcon.step import Advanced, Dynamics
    from jaxcon.system.body_system import Snapshot
    from jaxcon.system.coordinates import JointCoordinate
    from jaxcon.system.layout import Layout, Place
    from jaxcon.system.state import Energy, State


class Constraint(Protocol):
    """A group of equality constraints of one kind, whose rows are computed together."""

    names: tuple[str, ...]
    """The names of the constraints."""

    places: tuple[Place, ...]
    """The bodies of the constraints, one `Place` for each side, such as all first bodies."""

    @abstractmethod
    def rows(self, snapshot: Snapshot) -> list[Row]:
        """The rows at one instant: φ, φ̇, γ, and the entries of J (`pulls`) for each place."""
        ...

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """The points about which torques are taken, world frame; None for centers of mass."""
        return None

    is_inertia: ClassVar[bool] = False
    """True for rotors: they add inertia and constrain nothing."""
    closes_loops: ClassVar[bool] = True
    """True if these constraints may close a loop of bodies, in which rows may be redundant."""
    independent: ClassVar[bool] = True
    """False if the rows of a single constraint may be linearly dependent."""
    has_vectors: ClassVar[bool] = False
    """True if rows may be the components of one vector along arbitrary axes, as in joints."""

    @property
    def driven(self) -> Hashable | None:
        """A key of the joint coordinate whose motion is prescribed; None if none is prescribed."""
        return None


class InequalityGroup(Protocol):
    """A group of elements of one kind with bounded λ: limits, contacts, friction or motors."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The names of the elements."""
        ...

    @abstractmethod
    def bounds(self, snapshot: Snapshot, control: PyTree, dt: Array) -> BoundSet:
        """The rows at one instant, and their target velocities for a step of dt [s]."""
        ...

    @property
    @abstractmethod
    def places(self) -> tuple[Place, ...]:
        """The bodies of the elements, one `Place` for each side, such as all first bodies."""
        ...

    @property
    @abstractmethod
    def numbers(self) -> Mapping[str, Any]:
        """The numeric fields by name. A world stops if a number is not finite."""
        ...

    @property
    def unbounded_fields(self) -> tuple[str, ...]:
        """The fields of `numbers` that may be infinite, such as the stops of a limit."""
        return ()

    @property
    def coordinate(self) -> JointCoordinate | None:
        """The joint coordinate on which the elements act; None for elements such as contacts."""
        return None

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """The points about which torques are taken, world frame; None for centers of mass."""
        return None


class System(TreeNode, Protocol):
    """A mechanical system: positions q, velocities v, and the equations M a = f + Jᵀλ.

    `BodySystem` (bodies), `GeneralizedCoordinates` (the user's own coordinates) and `Vakonomic`
    implement it.
    """

    @property
    def constraints(self) -> tuple[Any, ...]:
        """Groups of equality constraints; see `Constraint`."""
        ...

    @property
    def bounds(self) -> tuple[Any, ...]:
        """Groups of inequality constraints; see `InequalityGroup`."""
        ...

    @property
    def forces(self) -> tuple[Any, ...]:
        """Groups of force elements; () where forces are the user's function."""
        ...

    def check(self, q: Array) -> None:
        """Checks numbers of the system that depend on q, (n_q,); `jc.init` calls this."""

    def columns(self, place: Place) -> Columns:
        """The columns of J that belong to the bodies of a `Place`."""
        ...

    @property
    def layout(self) -> Layout | None:
        """Names and indices of bodies and controls; None where coordinates have no names."""
        ...

    @property
    def n_v(self) -> int:
        """The number of velocities."""
        ...

    def sizes(self, n_q: int) -> tuple[int, int]:
        """The expected lengths of q and v; n_q is the length of the given q."""
        ...

    def snapshot(self, q: Array, v: Array, t: Doubled | Scalar) -> Snapshot:
        """The system at one instant, which computes each frame and joint coordinate only once."""
        ...

    def mass(self, q: Array) -> Mass:
        """The mass matrix M, (n_v, n_v)."""
        ...

    def force(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """The generalized force f, (n_v,) [N, N m], including the gyroscopic force −ω × Iω."""
        ...

    def applied(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """The generalized force f without the gyroscopic force, (n_v,) [N, N m]."""
        ...

    def complete(self, solution: Solution) -> Solution:
        """Adds accelerations that follow from multipliers, such as μ̇ = −λ of `Vakonomic`."""
        ...

    def energy(self, q: Array, v: Array, t: Doubled | Scalar) -> Energy:
        """Kinetic and potential energy [J]."""
        ...

    @property
    def params(self) -> Any:
        """The parameters of the system, a pytree.

        For bodies, it is a dictionary by the names of elements and of their fields.
        """
        ...

    def with_params(self, changes: Any, /) -> Self:
        """The system with changed parameters; compiled functions are not traced again."""
        ...

    # kinematics: v equals q̇ in the plane and for generalized coordinates, but not in space

    def kinematics(self, q: Array, v: Array) -> Array:
        """The rates of change q̇ of the positions, (n_q,), for velocities v."""
        ...

    def retract(self, q: Array, step: Array) -> Array:
        """The positions q ⊕ Δ after a step Δ = h v, (n_v,); rotations use the exponential map."""
        ...

    def normalize(self, q: Array) -> Array:
        """The positions q with quaternions scaled to unit length, (n_q,)."""
        ...

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """The momentum p after a step Δ, transformed to the start of Δ: (dexp⁻¹_Δ)ᵀ p, (n_v,)."""
        ...

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """The rate ad*_v p, (n_v,), of a body-frame momentum p due to the turning of the frames."""
        ...

    def extent(self, q: Array) -> Array:
        """The largest |x| of the position coordinates x, () [m], for bounds on rounding errors."""
        ...

    # rotations in space, whose free motion integrators advance separately

    @property
    def has_bodies(self) -> bool:
        """True for a system of bodies; False if the coordinates need not belong to bodies."""
        ...

    @property
    def turns_in_space(self) -> bool:
        """True if bodies have an orientation in space."""
        ...

    # whole turns of joints and planar bodies, which a state counts

    @property
    def counted(self) -> tuple[JointCoordinate, ...]:
        """The joint coordinates whose whole turns are counted."""
        ...

    @property
    def turns(self) -> Array | tuple[()]:
        """Expected angles of counted coordinates, (n,) [rad], within half a turn; () for none."""
        ...

    def with_turns(self, turns: Array | tuple[()], remainder: Array | tuple[()] = ()) -> Self:
        """The system with other expected angles `turns` and rounding errors `remainder`."""
        ...

    def no_remainder(self, dtype: DType) -> Array | tuple[()]:
        """The `angle_remainder` of a new state: zeros, or () if whole turns stay in q."""
        ...

    def unwind(self, q: Array) -> tuple[Self, Array]:
        """Moves whole turns of angles from q into the system; returns the new system and q."""
        ...

    def rewind(self, q: Array, after: Array) -> tuple[Array, Array | tuple[()]]:
        """Restores whole turns after a step; returns positions and rounding errors of angles.

        Args:
            q: positions at the start of the step, with whole turns, (n_q,).
            after: positions at the end of the step, computed without whole turns, (n_q,).
        """
        ...

    def count(self, q: Array, v: Array, t: Doubled | Scalar) -> Any:
        """The values of the counted coordinates, whole turns included, (n,) [rad]."""
        ...

    def expect(self, here: Snapshot, end: Array, dt: Array, within: bool) -> tuple[Any, Array]:
        """The expected angles of counted coordinates after a step, and an error bound, () [rad].

        Args:
            here: the snapshot at the start of the step.
            end: v after the step, (n_v,).
            dt: h, () [s].
            within: True if angles are also read inside the step.
        """
        ...


class Bodies(System, Protocol):
    """A system of bodies; integrators advance free rotations in space separately."""

    def kinetic_energy(self, q: Array, v: Array) -> Array:
        """The kinetic energy ½ vᵀMv, without that of rotors, () [J]."""
        ...

    def kick(
        self, q: Array, v: Array, acceleration: Array, dt: Array, small: bool = False
    ) -> Array:
        """The velocities after a step of v̇ = a, (n_v,); free rotation is advanced separately.

        Args:
            q: positions, (n_q,).
            v: velocities before the step, (n_v,).
            acceleration: a at q and v, (n_v,), with its gyroscopic part.
            dt: h, (1,) [s].
            small: True for a cheaper rule, for bodies that turn by far less than a radian.
        """
        ...

    def rotate(self, q: Array, v: Array, dt: Array) -> Array:
        """The velocities, (n_v,), after torque-free rotation for the time dt, (1,) [s]."""
        ...

    def coast(self, q: Array, v: Array, dt: Array) -> Array:
        """The mean gyroscopic acceleration of a free rotation, less its initial value, (n_v,)."""
        ...

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """The gyroscopic part of the acceleration a, (n_v,)."""
        ...

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """The velocity change p, (n_v,), expressed in body frames that have turned by a step Δ."""
        ...

    def by_body(self, q: Array, x: Array) -> Array:
        """A mask of velocities, (n_v,): True for all velocities of a body with a nonzero x."""
        ...

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Rows, dt: Array) -> Array:
        """The square of the largest turn of a body or rod in a step, () [rad²].

        Args:
            q: positions, (n_q,).
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
        """
        ...

    def squared_turns(
        self, v: Array, before: Array, rows: Rows, dt: Array, whole: bool = False
    ) -> Array:
        """The square of the largest turn of an arm or axis of each row, (n_c,) [rad²].

        Args:
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
            whole: True to include rotation about an arm or axis, which does not turn it.
        """
        ...


class Stabilizer(TreeNode, Protocol):
    """Chooses b and C of J a + C λ = b, so that errors of the constraints do not grow.

    Only `constraint_equations` is required. b = −γ makes φ̈ zero, but errors of φ and φ̇ then grow;
    see `Unstabilized`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuses classes that define a method by its name of version 0.1, which nothing calls.

        Raises:
            TypeError: the class defines `target`, `impose` or `bounded`.
        """
        super().__init_subclass__(**options)
        renamed = {"target": "constraint_equations", "impose": "constraint_equations"}
        for old, new in (renamed | {"bounded": "cap_gains"}).items():
            inherited = any(
                old in vars(base) for base in cls.__mro__[1:]
            )  # the base that defines the old name also calls it
            if callable(vars(cls).get(old)) and new not in vars(cls) and not inherited:
                raise TypeError(
                    f"{cls.__name__}: the method `{old}` of stabilizers is `{new}` since version"
                    " 0.2; see jc.extend.Stabilizer for its arguments."
                )

    def check(self) -> None:
        """Checks the numbers of the part; by default, does nothing.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def constraint_equations(self, rows: Rows, memory: Any, dt: Array) -> Rows:
        """Returns the rows with their target b, by `rows.with_target(b)`.

        To change C or f, also set the fields `compliance` or `force` of the rows.

        Args:
            rows: φ, φ̇, J, γ at one instant. With `SemiImplicitEuler`, φ̇ is the rate half a step
                earlier.
            memory: the stabilizer's memory after the last step, the same at all stages of the step.
            dt: h, () [s].
        """
        ...

    @property
    def reduces_errors(self) -> bool:
        """False if errors φ of the constraints may grow without bound, as without feedback."""
        return True

    def solve(
        self, solver: Solver, rows: Rows, memory: Any, dt: Array, system: Saddle
    ) -> Solution | None:
        """The solution, if the stabilizer computes it by itself; None to use the solver."""
        return None

    @property
    def solves(self) -> bool:
        """True if the stabilizer computes the solution by its own `solve`."""
        return type(self).solve is not Stabilizer.solve

    # memory: integrals, histories, the λ of the last step. `jc.init` calls `init` and puts the
    # result into `State.memory`; `jc.step` and `jc.rollout` refuse a state without it. At the end
    # of each step the new memory is remember(advance(rows, memory, dt), solution); `correct` and
    # the next step get it. `jc.forward_dynamics` uses the memory but does not update it. Leaves are
    # arrays whose shapes and dtypes do not change; a batch adds an axis at the end.

    def init(self, system: System, q: Array, v: Array) -> Any:
        """The memory at the start of a simulation of one world; () for none.

        To size it by the number of rows, call `constraints.rows.linearize(system, q, v, 0.0)`.
        """
        return ()

    def advance(self, rows: Rows, memory: Any, dt: Array) -> Any:
        """The memory after a step of dt [s], from the rows at its start."""
        return memory

    def remember(self, memory: Any, solution: Solution) -> Any:
        """The memory after a step, from the a and λ of the step.

        a and λ belong to the start of the step, or to its end with `GeneralizedAlpha`. With contact
        they are means over the step. λ has the equality rows only, (n_c,).
        """
        return memory

    # correction of q and v after a step

    def correct(
        self,
        system: System,
        solver: Solver,
        before: State,
        state: State,
        memory: Any,
        dt: Array,
    ) -> tuple[State, Array]:
        """The corrected state after a step, and a status.

        Args:
            system: the system.
            solver: the linear solver of the method.
            before: the state before the step.
            state: the state after the step, to be corrected.
            memory: the stabilizer's memory after the step.
            dt: h, () [s].
        """
        return state, 0 * state.status

    @property
    def corrects(self) -> tuple[str, ...]:
        """The levels that `correct` changes: "position", "velocity", both or none."""
        moves = type(self).correct is not Stabilizer.correct
        return ("position", "velocity") if moves else ()

    @property
    def completes(self) -> bool:
        """True if `correct` adds the missing constraint forces of the step, like `Projection()`.

        After each step, φ = 0 at the new q, and φ̇ = 0 at the new q and v.
        """
        return False

    @property
    def remembers(self) -> bool:
        """True if the stabilizer has a memory, that is, if it overrides `init`."""
        return type(self).init is not Stabilizer.init

    # only for stabilizers with default gains, which depend on the integrator and the step

    def resolve(self, gains: tuple[Scalar, Scalar]) -> Self:
        """The stabilizer with (α, β) [1/s] in place of gains that were not given."""
        return self

    def rising(self, limit: Scalar) -> Self:
        """The stabilizer with default gains that rise to β ≤ limit [1/s] in fast motions."""
        return self

    def steady(self, gains: tuple[Scalar, Scalar]) -> Self:
        """The stabilizer with default gains (α, β) [1/s] that do not rise."""
        return self

    def cap_gains(self, stable_rate: Callable[[float], Any]) -> Self:
        """The stabilizer with gains below the largest stable β [1/s].

        Args:
            stable_rate: function of the smallest damping ratio α/β of the gains; returns the
                largest stable β [1/s].
        """
        return self


class Integrator(TreeNode, Protocol):
    """Advances q and v by accelerations.

    `advance` and `default_gains` are required. `report`, warnings about unstable gains and
    `Stabilizer.cap_gains` also need `growth`.
    """

    symmetric: ClassVar[bool] = False
    """True if a step by −h undoes a step by h."""
    supports_inequalities: ClassVar[bool] = True
    """True if the integrator works in scenes with limits, friction and contact."""
    reads_within: ClassVar[bool] = True
    """True if the integrator reads angles inside a step, not only at its start."""

    def check(self) -> None:
        """Checks the numbers of the part; by default, does nothing.

        Raises:
            ValueError: a number is out of range.
        """

    def init(self, system: System, q: Array, v: Array) -> Any:
        """The memory at the start of a simulation; () for none."""
        return ()

    @abstractmethod
    def advance(self, dynamics: Dynamics, state: State, memory: Any, dt: Array) -> Advanced:
        """Advances a state by one step of dt [s].

        Args:
            dynamics: the equations of motion; `dynamics(q, v, t)` solves for a and λ.
            state: the state at the start of the step.
            memory: the integrator's memory.
            dt: h, () [s].
        """
        ...

    @abstractmethod
    def default_gains(self, dt: Array) -> tuple[Any, Any]:
        """The feedback gains (α, β) [1/s] that suit a step of dt [s]."""
        ...

    def highest_rate(self, dt: Array) -> Any:
        """The largest β [1/s] to which default gains may rise in float32; None if they do not."""
        return None

    @property
    def has_rising_gains(self) -> bool:
        """True if default gains may rise; see `highest_rate`."""
        return type(self).highest_rate is not Integrator.highest_rate

    def growth(self, alpha: float, beta: float, dt: float) -> float | None:
        """The growth factor of a constraint error in a step, a spectral radius; None if unknown.

        Args:
            alpha: the feedback gain α [1/s].
            beta: the feedback gain β [1/s].
            dt: h [s].
        """
        return None

    def error_map(
        self, alpha: Number, beta: Number, dt: Number
    ) -> tuple[tuple[Any, Any], tuple[Any, Any], tuple[Any, Any]] | None:
        """Three errors (φ, φ̇) after a step with feedback; None if unknown.

        The errors before the step are φ = 1, then φ̇ = 1, then zero. In the third case a
        disturbance φ̈ = 1 acts during the step.
        """
        return None

    def refuses(self, system: System, stabilizer: Stabilizer) -> str | None:
        """The reason to refuse a system or stabilizer; None if the integrator works with both."""
        return None


class Solver(TreeNode, Protocol):
    """Solves the saddle system M a = f + Jᵀλ, J a + C λ = b."""

    def check(self) -> None:
        """Checks the numbers of the part; by default, does nothing.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def factor(self, system: Saddle) -> Factored:
        """Factors M, J and C; returns a function (f, b) → solution. Ignores f and b of `system`."""
        ...

    def solve(self, system: Saddle) -> Solution:
        """The accelerations a and multipliers λ that solve the saddle system."""
        return self.factor(system)(system.force, system.target)


class ContactSolver(TreeNode, Protocol):
    """Finds the multipliers λ of inequality rows.

    λ and the velocities u = G λ + c of the rows obey the law of each row. u is the velocity at the
    end of the step less its target, G the response of u to λ, and c the value of u without λ.
    """

    @property
    def exact(self) -> bool:
        """True if the laws of the rows hold to rounding.

        Landings (impacts without rebound) are then resolved as impacts within a step.
        """
        return False

    @property
    def warm(self) -> bool:
        """True if the solver starts from the multipliers of the last step (warm start)."""
        return False

    @property
    def smoothing(self) -> Scalar | None:
        """The width of rounded corners of the rows' laws, for derivatives only [m/s, rad/s]."""
        return None

    @property
    def regularization(self) -> Scalar | None:
        """The least compliance of rows, as a share of their inverse mass; None for exact laws."""
        return None

    def check(self) -> None:
        """Checks the numbers of the solver.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def solve(self, problem: Bounded, start: Array) -> Array:
        """The multipliers λ, (n,), from the initial guess `start`, (n,)."""
        ...


class Adjoint(TreeNode, Protocol):
    """Chooses which states the reverse pass of a rollout keeps, and which it recomputes."""

    def check(self) -> None:
        """Checks the numbers of the part; by default, does nothing.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def scan(self, path: Path) -> tuple[State, Any]:
        """Runs a rollout; returns its final state and its record."""
        ...

    @abstractmethod
    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """The number of states that the reverse pass keeps at each level of checkpoints."""
        ...
