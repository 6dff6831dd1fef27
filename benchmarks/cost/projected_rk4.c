/* RK4 with projection, as one would write it by hand in C for one system: what overhead.py compares
   against. Compiled once per system (-DRIGID_BODY or -DVORTICES=3) and vector width (-DLANES=1 for one
   trajectory; a batch runs LANES of them side by side, the struct of arrays in vector registers, where
   they stay for all steps).

   The algorithm is that of ManifoldProjection(RK4(), ..., projection=SimplifiedNewton()): the constraint
   Jacobian frozen at the candidate, two iterations written out, further ones only where a residual is
   above four units of roundoff of its scale. Less than the package does: no guard against dependent
   constraints, no report, no error if an iteration does not converge, scales at the candidate only. */

#include <float.h>
#include <limits.h>
#include <math.h>

typedef double real __attribute__((vector_size(LANES * sizeof(double))));
typedef long bits __attribute__((vector_size(LANES * sizeof(long)))); /* what a comparison gives */

#define SUM(i, n, term) ({ real total_ = {0}; for (int i = 0; i < (n); ++i) total_ += (term); total_; })

static inline real absolute(real x) { return (real)((bits)x & LONG_MAX); } /* drops the sign bit */

#ifdef RIGID_BODY

enum { N = 3, M = 2 };
static const double I[N] = {0.1, 0.2, 0.3};

/* w is the angular momentum in the frame of the body. */
static inline void vector_field(const real *w, real *f) {
    f[0] = (I[1] - I[2]) / (I[1] * I[2]) * w[1] * w[2];
    f[1] = (I[2] - I[0]) / (I[2] * I[0]) * w[2] * w[0];
    f[2] = (I[0] - I[1]) / (I[0] * I[1]) * w[0] * w[1];
}

static inline void integrals(const real *w, real *v) {
    v[0] = SUM(i, N, 1 / (2 * I[i]) * w[i] * w[i]);
    v[1] = SUM(i, N, 0.5 * w[i] * w[i]);
}

static inline void gradients(const real *w, real G[M][N]) {
    for (int i = 0; i < N; ++i) {
        G[0][i] = 1 / I[i] * w[i];
        G[1][i] = w[i];
    }
}

#else /* vortices of strength 1: x_0, y_0, x_1, y_1, ... */

enum { N = 2 * VORTICES, M = 4 };

static inline real logarithm(real x) {
    real out;
#pragma omp simd
    for (int l = 0; l < LANES; ++l) out[l] = log(x[l]);
    return out;
}

/* dH/dy_i and -dH/dx_i, with every pair visited once. */
static inline void vector_field(const real *y, real *f) {
    for (int i = 0; i < N; ++i) f[i] = (real){0};
    for (int i = 0; i < VORTICES; ++i)
        for (int j = i + 1; j < VORTICES; ++j) {
            real dx = y[2 * i] - y[2 * j], dy = y[2 * i + 1] - y[2 * j + 1];
            real rate = 1 / (2 * M_PI * (dx * dx + dy * dy));
            f[2 * i] -= rate * dy, f[2 * i + 1] += rate * dx;
            f[2 * j] += rate * dy, f[2 * j + 1] -= rate * dx;
        }
}

static inline void integrals(const real *y, real *v) {
    real product = {0};
    product += 1;
    for (int i = 0; i < VORTICES; ++i)
        for (int j = i + 1; j < VORTICES; ++j) {
            real dx = y[2 * i] - y[2 * j], dy = y[2 * i + 1] - y[2 * j + 1];
            product *= dx * dx + dy * dy;
        }
    v[0] = logarithm(product) / (-4 * M_PI); /* one logarithm for all pairs */
    v[1] = SUM(i, VORTICES, y[2 * i]);
    v[2] = SUM(i, VORTICES, y[2 * i + 1]);
    v[3] = SUM(i, N, y[i] * y[i]);
}

static inline void gradients(const real *y, real G[M][N]) {
    real f[N];
    vector_field(y, f);
    for (int i = 0; i < N; i += 2) {
        G[0][i] = -f[i + 1], G[0][i + 1] = f[i];
        G[1][i] = (real){0} + 1, G[1][i + 1] = (real){0};
        G[2][i] = (real){0}, G[2][i + 1] = (real){0} + 1;
        G[3][i] = 2 * y[i], G[3][i + 1] = 2 * y[i + 1];
    }
}

#endif

static inline void rk4(real *y, double h) {
    real k1[N], k2[N], k3[N], k4[N], z[N];
    vector_field(y, k1);
    for (int i = 0; i < N; ++i) z[i] = y[i] + h / 2 * k1[i];
    vector_field(z, k2);
    for (int i = 0; i < N; ++i) z[i] = y[i] + h / 2 * k2[i];
    vector_field(z, k3);
    for (int i = 0; i < N; ++i) z[i] = y[i] + h * k3[i];
    vector_field(z, k4);
    for (int i = 0; i < N; ++i) y[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
}

/* L D L^T of the Gram matrix, in place; the diagonal holds 1/D. */
static inline void factorise(real A[M][M], real G[M][N]) {
    for (int i = 0; i < M; ++i)
        for (int j = 0; j <= i; ++j) A[i][j] = A[j][i] = SUM(k, N, G[i][k] * G[j][k]);
    for (int k = 0; k < M; ++k) {
        A[k][k] = 1 / A[k][k];
        for (int i = k + 1; i < M; ++i) {
            real factor = A[i][k] * A[k][k];
            for (int j = k + 1; j <= i; ++j) A[i][j] -= factor * A[j][k];
            for (int j = k + 1; j < i; ++j) A[j][i] = A[i][j];
        }
        for (int i = k + 1; i < M; ++i) A[k][i] = A[i][k] * A[k][k]; /* L, in the upper triangle */
    }
}

static inline void solve(real A[M][M], real *x) {
    for (int i = 1; i < M; ++i)
        for (int j = 0; j < i; ++j) x[i] -= A[j][i] * x[j];
    for (int i = M - 1; i >= 0; --i) {
        x[i] *= A[i][i];
        for (int j = i + 1; j < M; ++j) x[i] -= A[i][j] * x[j];
    }
}

static inline int satisfied(const real *g, const real *tolerance) {
    bits large = {0};
    for (int c = 0; c < M; ++c) large |= absolute(g[c]) > tolerance[c];
    long any = 0;
    for (int l = 0; l < LANES; ++l) any |= large[l];
    return any == 0;
}

static inline void project(real *y, const real *value) {
    real G[M][N], A[M][M], g[M], tolerance[M];
    gradients(y, G);
    factorise(A, G);
    integrals(y, g);
    for (int c = 0; c < M; ++c) {
        g[c] -= value[c];
        tolerance[c] =
            4 * DBL_EPSILON * (absolute(value[c]) + SUM(i, N, absolute(y[i] * G[c][i])));
    }
    for (int count = 0; count < 2 || (count < 20 && !satisfied(g, tolerance)); ++count) {
        solve(A, g);
        for (int i = 0; i < N; ++i) y[i] -= SUM(c, M, G[c][i] * g[c]);
        integrals(y, g);
        for (int c = 0; c < M; ++c) g[c] -= value[c];
    }
}

/* `states`: trajectories x N, in place. */
void integrate(double *states, long trajectories, long steps, double h, int projected) {
    for (long first = 0; first < trajectories; first += LANES) {
        long lanes = trajectories - first < LANES ? trajectories - first : LANES;
        real y[N], value[M];
        for (int i = 0; i < N; ++i)
            for (long l = 0; l < LANES; ++l) /* the last lane fills up an incomplete vector */
                y[i][l] = states[(first + (l < lanes ? l : lanes - 1)) * N + i];
        integrals(y, value);
        if (projected)
            for (long n = 0; n < steps; ++n) rk4(y, h), project(y, value);
        else
            for (long n = 0; n < steps; ++n) rk4(y, h);
        for (int i = 0; i < N; ++i)
            for (long l = 0; l < lanes; ++l) states[(first + l) * N + i] = y[i][l];
    }
}
