# pyright: strict
"""The protocols of the parts of a simulation. Read this file first.

`step.py` and the layers around it know the parts of a scene and of a method by these protocols:

    System           what moves: M, f, the kinematics of q, and its constraints
    Constraint       equal equality constraints, side by side: φ, φ̇, J and γ
    InequalityGroup  equal limits, contacts or motors, side by side
    Stabilizer       b and C of J a + C λ = b, and the correction after a step
    Integrator       the next q and v from accelerations
    Solver           a and λ of M a = f + Jᵀλ, J a + C λ = b
    ContactSolver    the multipliers of inequality constraints
    Adjoint          what the reverse pass of a rollout keeps

To write a part, inherit from its protocol. Methods marked `@abstractmethod` and fields without a
value are required, all other methods of a part have a default. A new `System` is the exception: it
needs all methods of its protocol, and those of `Bodies` if it consists of bodies.
Parts are pytrees (`core.pytree`), so that their numbers can be traced, batched and differentiated.
Arrays have the shapes that the docstrings give, and in a batch of worlds one more axis at the end.
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
    """A group of equal equality constraints of a system, stored side by side."""

    names: tuple[str, ...]
    """The names of the constraints."""

    places: tuple[Place, ...]
    """The bodies on each side of the constraints."""

    @abstractmethod
    def rows(self, snapshot: Snapshot) -> list[Row]:
        """φ, φ̇, J and γ of the group at one instant; each row has a pull for each place."""
        ...

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """The points about which wrenches are given, world frame; None for centers of mass."""
        return None

    is_inertia: ClassVar[bool] = False
    """True for rotors: they add inertia and constrain nothing."""
    closes_loops: ClassVar[bool] = True
    """True where rows depend on others if they close a loop of bodies, as those of joints do."""
    independent: ClassVar[bool] = True
    """False where the rows of one constraint may depend on each other."""
    has_vectors: ClassVar[bool] = False
    """True where rows are components of vectors along axes that were chosen freely."""

    @property
    def driven(self) -> Hashable | None:
        """The joint coordinate whose motion is prescribed; None for none."""
        return None


class InequalityGroup(Protocol):
    """A group of equal elements with bounded multipliers: limits, contacts, friction, motors."""

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
        """The bodies on each side of the elements."""
        ...

    @property
    @abstractmethod
    def numbers(self) -> Mapping[str, Any]:
        """The numbers by field. A world with a number that is not finite stops."""
        ...

    @property
    def unbounded_fields(self) -> tuple[str, ...]:
        """The fields of `numbers` that may be infinite."""
        return ()

    @property
    def coordinate(self) -> JointCoordinate | None:
        """The joint coordinate on which the elements act; None for contacts and the like."""
        return None

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """The points about which wrenches are given, world frame; None for centers of mass."""
        return None


class System(TreeNode, Protocol):
    """Positions q, velocities v, and M a = f + Jᵀλ.

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
        """Checks numbers that depend on q, (n_q,), when a state is made."""

    def columns(self, place: Place) -> Columns:
        """The columns of J that belong to the bodies of a place."""
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
        """The numbers of positions and velocities of a state that has n_q positions."""
        ...

    def snapshot(self, q: Array, v: Array, t: Doubled | Scalar) -> Snapshot:
        """The system at one instant; frames and joint coordinates are computed once in it."""
        ...

    def mass(self, q: Array) -> Mass:
        """M, (n_v, n_v)."""
        ...

    def force(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """f, (n_v,) [N, N m], the gyroscopic force −ω × Iω included."""
        ...

    def applied(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """f without the gyroscopic force, (n_v,) [N, N m]."""
        ...

    def complete(self, solution: Solution) -> Solution:
        """The solution with accelerations that follow from multipliers, as μ̇ = −λ."""
        ...

    def energy(self, q: Array, v: Array, t: Doubled | Scalar) -> Energy:
        """Kinetic and potential energy [J]."""
        ...

    @property
    def params(self) -> Any:
        """The numbers of the system: by element and field for bodies, any pytree elsewhere."""
        ...

    def with_params(self, changes: Any, /) -> Self:
        """The system with other numbers; nothing is traced again."""
        ...

    # kinematics: v is q̇ in the plane and on generalized coordinates, and not in space

    def kinematics(self, q: Array, v: Array) -> Array:
        """q̇, (n_q,)."""
        ...

    def retract(self, q: Array, step: Array) -> Array:
        """q ⊕ Δ for a finite step Δ = h v, (n_v,); rotations by their exponential."""
        ...

    def normalize(self, q: Array) -> Array:
        """q with quaternions of unit length."""
        ...

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """(dexp⁻¹_Δ)ᵀ p, (n_v,): a momentum after a step Δ as seen from its start."""
        ...

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """ad*_v p, (n_v,): the rate at which turning with the bodies changes a momentum p."""
        ...

    def extent(self, q: Array) -> Array:
        """The largest coordinate, () [m], for bounds on rounding errors."""
        ...

    # rotations in space, whose free motion integrators advance separately

    @property
    def has_bodies(self) -> bool:
        """True for a system of bodies; False where it is not known which coordinates turn."""
        ...

    @property
    def turns_in_space(self) -> bool:
        """True where bodies have an orientation in space."""
        ...

    # whole turns of joints and planar bodies, which a state counts

    @property
    def counted(self) -> tuple[JointCoordinate, ...]:
        """The joint coordinates whose whole turns are counted."""
        ...

    @property
    def turns(self) -> Array | tuple[()]:
        """Angles within half a turn of the counted coordinates, (n,) [rad]; () for none."""
        ...

    def with_turns(self, turns: Array | tuple[()], remainder: Array | tuple[()] = ()) -> Self:
        """The system with these reference angles."""
        ...

    def no_remainder(self, dtype: DType) -> Array | tuple[()]:
        """The `angle_remainder` of a state that has made no turns."""
        ...

    def unwind(self, q: Array) -> tuple[Self, Array]:
        """The system that knows the whole turns in q, and q without them."""
        ...

    def rewind(self, q: Array, after: Array) -> tuple[Array, Array | tuple[()]]:
        """The end of a step with the whole turns of its start q, and the rounding remainder."""
        ...

    def count(self, q: Array, v: Array, t: Doubled | Scalar) -> Any:
        """The counted coordinates over all turns, (n,) [rad]."""
        ...

    def expect(self, here: Snapshot, end: Array, dt: Array, within: bool) -> tuple[Any, Array]:
        """The expected counted coordinates after a step, and their largest error, () [rad]."""
        ...


class Bodies(System, Protocol):
    """A system of bodies; integrators advance the rotations in space separately from the rest."""

    def kinetic_energy(self, q: Array, v: Array) -> Array:
        """The kinetic energy ½ vᵀMv, without that of rotors, () [J]."""
        ...

    def kick(
        self, q: Array, v: Array, acceleration: Array, dt: Array, small: bool = False
    ) -> Array:
        """v after a step of dt (1,) [s] under a, (n_v,); free rotation is advanced separately."""
        ...

    def rotate(self, q: Array, v: Array, dt: Array) -> Array:
        """v after a free rotation of dt (1,) [s], (n_v,)."""
        ...

    def coast(self, q: Array, v: Array, dt: Array) -> Array:
        """The mean gyroscopic acceleration of a free rotation less that at its start, (n_v,)."""
        ...

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """The gyroscopic part of the acceleration a, (n_v,)."""
        ...

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """The change p of velocities in body frames that have turned by Δ, (n_v,)."""
        ...

    def by_body(self, q: Array, x: Array) -> Array:
        """A mask of the velocities of bodies that have a nonzero x, (n_v,)."""
        ...

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Rows, dt: Array) -> Array:
        """The square of the largest turn of a body or rod in a step, () [rad²]."""
        ...

    def squared_turns(
        self, v: Array, before: Array, rows: Rows, dt: Array, whole: bool = False
    ) -> Array:
        """The squared largest turn of the arms and axes of each row in a step, (n_c,) [rad²]."""
        ...


class Stabilizer(TreeNode, Protocol):
    """Chooses b and C of J a + C λ = b, so that errors of the constraints do not grow.

    `constraint_equations` is the one method that is required. b = −γ holds φ̈ = 0 alone, so that
    errors of φ and φ̇ grow; see `Unstabilized`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuses methods of version 0.1, which would never be called.

        Raises:
            TypeError: the class defines `target`, `impose` or `bounded`.
        """
        super().__init_subclass__(**options)
        renamed = {"target": "constraint_equations", "impose": "constraint_equations"}
        for old, new in (renamed | {"bounded": "cap_gains"}).items():
            inherited = any(
                old in vars(base) for base in cls.__mro__[1:]
            )  # by a base that calls it
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
        """The rows with their target b, as `rows.with_target(b)` returns them.

        To change C or f, also set the fields `compliance` or `force` of the rows.

        Args:
            rows: φ, φ̇, J, γ at one instant, with φ̇ as feedback sees it.
            memory: of this stabilizer, as of the end of the last step; the same at all stages of
                the step.
            dt: h, () [s].
        """
        ...

    def solve(
        self, solver: Solver, rows: Rows, memory: Any, dt: Array, system: Saddle
    ) -> Solution | None:
        """The solution, where the stabilizer has a method of its own; None to use the solver's."""
        return None

    @property
    def solves(self) -> bool:
        """True where `solve` has a method of its own."""
        return type(self).solve is not Stabilizer.solve

    # memory: integrals, histories, the λ of the last step. `jc.init` calls `init` and puts the
    # result into `State.memory`; `jc.step` and `jc.rollout` refuse a state without it. At the end
    # of each step it becomes remember(advance(rows, memory, dt), solution), which `correct` and the
    # next step get. `jc.forward_dynamics` uses the memory and does not update it. Leaves are arrays
    # whose shapes and dtypes stay; a batch adds an axis at their end.

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

        They belong to the start of the step; with contact they are means over the step, and with
        `GeneralizedAlpha` they belong to its end. λ is that of equality rows, (n_c,).
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
        """The corrected state after a step, and a status."""
        return state, 0 * state.status

    @property
    def corrects(self) -> tuple[str, ...]:
        """The levels that `correct` changes: "position", "velocity", both or none."""
        moves = type(self).correct is not Stabilizer.correct
        return ("position", "velocity") if moves else ()

    @property
    def completes(self) -> bool:
        """True where `correct` finds the constraint forces of the step, as `Projection` does.

        It then keeps φ = 0 at q⁺ and φ̇ = 0 at (q⁺, v⁺).
        """
        return False

    @property
    def remembers(self) -> bool:
        """True where there is a memory, so that `init` is overridden."""
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
            stable_rate: the smallest damping ratio α/β of the gains ↦ the largest stable β.
        """
        return self


class Integrator(TreeNode, Protocol):
    """Advances q and v by accelerations.

    `advance` and `default_gains` are required. `report`, warnings of unstable gains and gains
    capped at the stable rate need `growth`, too.
    """

    symmetric: ClassVar[bool] = False
    """True where a step by −h undoes one by h."""
    supports_inequalities: ClassVar[bool] = True
    """True where limits, friction and contact may act beside it."""
    reads_within: ClassVar[bool] = True
    """True where it reads angles between the ends of a step."""

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
        """One step of dt [s] from a state.

        Args:
            dynamics: `dynamics(q, v, t)` solves for a and λ.
            state: at the start.
            memory: of this integrator.
            dt: h, () [s].
        """
        ...

    @abstractmethod
    def default_gains(self, dt: Array) -> tuple[Any, Any]:
        """The feedback gains (α, β) [1/s] that suit a step of dt [s]."""
        ...

    def highest_rate(self, dt: Array) -> Any:
        """β [1/s] to which default gains may rise in float32; None where they do not rise."""
        return None

    @property
    def has_rising_gains(self) -> bool:
        """True where default gains may rise; see `highest_rate`."""
        return type(self).highest_rate is not Integrator.highest_rate

    def growth(self, alpha: float, beta: float, dt: float) -> float | None:
        """The factor by which a constraint error may grow in a step: a spectral radius; or None."""
        return None

    def error_map(
        self, alpha: Number, beta: Number, dt: Number
    ) -> tuple[tuple[Any, Any], tuple[Any, Any], tuple[Any, Any]] | None:
        """Three pairs (φ, φ̇) after a step: from φ = 1, from φ̇ = 1, and under φ̈ = 1; or None."""
        return None

    def refuses(self, system: System, stabilizer: Stabilizer) -> str | None:
        """The reason why it does not work with a system or stabilizer; None where it does."""
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
        """The solution as a function of f and b; those of the system are not used."""
        ...

    def solve(self, system: Saddle) -> Solution:
        """The acceleration and the multipliers."""
        return self.factor(system)(system.force, system.target)


class ContactSolver(TreeNode, Protocol):
    """Finds multipliers λ of inequality rows: u = G λ + c, each row obeying its law."""

    @property
    def exact(self) -> bool:
        """True if laws are met to rounding; landings are then impacts within a step."""
        return False

    @property
    def warm(self) -> bool:
        """True if it starts from the multipliers of the last step."""
        return False

    @property
    def smoothing(self) -> Scalar | None:
        """The width of smoothed corners of the laws, for the derivative only [m/s, rad/s]."""
        return None

    def check(self) -> None:
        """Checks the numbers of the solver.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def solve(self, problem: Bounded, start: Array) -> Array:
        """λ, (n,), from a first guess (n,)."""
        ...


class Adjoint(TreeNode, Protocol):
    """Chooses what the reverse pass of a rollout keeps."""

    def check(self) -> None:
        """Checks the numbers of the part; by default, does nothing.

        Raises:
            ValueError: a number is out of range.
        """

    @abstractmethod
    def scan(self, path: Path) -> tuple[State, Any]:
        """The final state of a rollout, and its record."""
        ...

    @abstractmethod
    def kept(self, steps: int, state: State) -> tuple[int, ...]:
        """The number of states that the reverse pass keeps, by level of checkpoints."""
        ...
