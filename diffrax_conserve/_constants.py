"""The numbers of the core, each with its reason."""

# A residual of at most this many units of roundoff of its scale counts as zero. Rounding the state
# and evaluating the residual contribute about one unit each, in long sums a few. The promise "16
# units of roundoff" is part of the documentation, and `tests/soak` checks it in long double. What
# else is compared with roundoff, such as the pivot of a constraint that depends on others, is
# compared with this many units of it.
TOLERANCE_IN_EPS = 16
# A residual of this many units is noise: rounding the state and evaluating the residual contribute
# about one unit each. An iteration can reduce it by chance only, so it is not corrected. Where the
# user sets a tolerance, noise is the same share of it, an eighth.
NOISE_IN_EPS = 2
# Newton's method makes at most this many iterations, unless the user says otherwise. In a solve two
# are usual. More are needed after a step of the solver that is much too long.
MAX_STEPS = 50
# The directions of a correction are the gradients at the candidate for this many steps. Newton's
# method converges quadratically, so a nearby candidate needs fewer. If these are not enough, the
# plane of the corrections may miss the manifold, as on a circular orbit, where the states with the
# given energy and angular momentum are a curve and not a surface. From then on the directions are
# the gradients at each iterate, or with more than `MAX_ELIMINATION` constraints at every sixth.
FROZEN_STEPS = 6
# A correction that does not help is shortened to this share of itself. A half needs twice as many
# evaluations where it is far too long, and a much smaller share rejects corrections that would have
# worked.
BACKTRACKING_FACTOR = 1 / 4
# Up to this many constraints the Gram matrix `G M⁻¹ Gᵀ` is factored anew at each iterate, with
# pivoting. For more that would take longer than the few iterations that it saves.
MAX_PIVOTED = 4
# This power of roundoff, times the root of the number of constraints, is added to the diagonal of
# larger Gram matrices, as a share of it, so that they can be factored where constraints depend on
# each other. The residuals of such constraints contradict each other by roundoff, which becomes an
# error of all multipliers, in the ratio of roundoff to what is added. With 16 units of roundoff one
# in five projections on the seven integrals of an orbit, of which five are independent, does not
# converge.
REGULARISATION_POWER = 3 / 4
# The number of steps of iterative refinement, which remove the error that this addition makes.
NUM_REFINEMENTS = 2
# In a batch the sums in a Gram matrix are written out for up to this many unknowns. They take a
# third of the time of a reduction; the program grows with them.
MAX_UNROLLED_SUM = 64
# The derivative of `clip` beyond the bounds; within them it is one. With zero, a
# constraint whose components are all at bounds would have no gradient, and would never be met.
SLOPE_BEYOND_BOUNDS = 1e-10
# Up to this many unknowns and constraints together a dense system is solved in each step: the
# equations of the nearest point in `Newton`, and those of sparse constraints that are coupled too
# widely for blocks, see `_large.sparse`.
MAX_DENSE_SYSTEM = 512
# A function is written out in scalars up to this many operations, with which compile time grows.
# With 512 the Cartesian pendulum, the vortices and the Toda lattice of the catalogue stayed in
# arrays: they compiled up to two seconds faster, and took two to five times as long. With 0
# nothing is written out.
MAX_SCALAR_OPERATIONS = 2048
# In a batch a function with more results than this stays in arrays. The ten integrals of three
# bodies and their gradients, 200 numbers, compiled twice as long in scalars, and took as long.
MAX_SCALAR_RESULTS = 64
# Where most operations are expected to simplify away, as in a derivative of a derivative, the
# attempt is given up only after this many times `MAX_SCALAR_OPERATIONS`. Each takes about 5 µs.
SIMPLIFICATION_FACTOR = 8
# The sparsity of a Jacobian is sought from this number of constraints on. With fewer a dense factor
# is as fast (`benchmarks/cost/many_constraints.py`).
MIN_SPARSE = 33
# From this number of unknowns on the linear systems of a stiff solver are solved by KLU, if their
# matrix is sparse. From the second on a dense one is announced.
MIN_KLU = 100
WARN_DENSE = 300
# A row is dense if it has more than this many times the elements of the median row: a bond has 6
# elements, an energy all of them.
DENSE_ROW_RATIO = 16
# A Jacobian with more dense rows than this is treated as dense, because each costs one reverse pass
# and a solve of the sparse system.
MAX_DENSE_ROWS = 16
# Dense matrices and blocks of sparse ones with up to this many rows are eliminated by operations
# with rows; with the size of blocks compile time grows. Larger dense ones are factored by LAPACK.
# Sparse ones whose blocks would be larger are factored by KLU, or solved by iteration; where KLU
# can be had it is faster, and compiles faster, from blocks of more than the second number on.
MAX_ELIMINATION, MAX_BLOCK_WITH_KLU = 16, 4
