/* CVODE (SUNDIALS 6 or 7) with and without its own projection, as one would call it from C: what
   work_precision.py compares against. Compiled once per system, -DRIGID_BODY or -DKEPLER.

   SUNDIALS projects with BDF only. The projection is the simplified Newton iteration of the package,
   on two integrals: at most two iterations with the gradients at the predicted state, further ones
   only where a residual is above four units of roundoff of its scale. */

#include <cvode/cvode.h>
#include <float.h>
#include <math.h>
#include <nvector/nvector_serial.h>
#include <sundials/sundials_context.h>
#include <sundials/sundials_version.h>
#include <sunnonlinsol/sunnonlinsol_fixedpoint.h>

#if SUNDIALS_VERSION_MAJOR < 7
#define SUN_COMM_NULL NULL
#endif

#ifdef RIGID_BODY

enum { N = 3, M = 2 };
static const double I[N] = {0.1, 0.2, 0.3};

static void rates(const double *w, double *f) {
    f[0] = (I[1] - I[2]) / (I[1] * I[2]) * w[1] * w[2];
    f[1] = (I[2] - I[0]) / (I[2] * I[0]) * w[2] * w[0];
    f[2] = (I[0] - I[1]) / (I[0] * I[1]) * w[0] * w[1];
}

static void integrals(const double *w, double *v) {
    v[0] = v[1] = 0;
    for (int i = 0; i < N; ++i) v[0] += w[i] * w[i] / (2 * I[i]), v[1] += w[i] * w[i] / 2;
}

static void gradients(const double *w, double G[M][N]) {
    for (int i = 0; i < N; ++i) G[0][i] = w[i] / I[i], G[1][i] = w[i];
}

#else /* Kepler: q_1, q_2, p_1, p_2 */

enum { N = 4, M = 2 };

static void rates(const double *y, double *f) {
    double r2 = y[0] * y[0] + y[1] * y[1], inverse = 1 / (r2 * sqrt(r2));
    f[0] = y[2], f[1] = y[3], f[2] = -y[0] * inverse, f[3] = -y[1] * inverse;
}

static void integrals(const double *y, double *v) {
    v[0] = (y[2] * y[2] + y[3] * y[3]) / 2 - 1 / sqrt(y[0] * y[0] + y[1] * y[1]);
    v[1] = y[0] * y[3] - y[1] * y[2];
}

static void gradients(const double *y, double G[M][N]) {
    double f[N];
    rates(y, f);
    G[0][0] = -f[2], G[0][1] = -f[3], G[0][2] = y[2], G[0][3] = y[3];
    G[1][0] = y[3], G[1][1] = -y[2], G[1][2] = -y[1], G[1][3] = y[0];
}

#endif

static int right_hand_side(sunrealtype t, N_Vector y, N_Vector f, void *data) {
    (void)t, (void)data;
    rates(N_VGetArrayPointer(y), N_VGetArrayPointer(f));
    return 0;
}

/* correction: what to add to y; the two integrals have the values `data`. */
static int project(sunrealtype t, N_Vector y_, N_Vector correction_, sunrealtype eps,
                   N_Vector error_, void *data) {
    (void)t, (void)eps, (void)error_;
    const double *start = N_VGetArrayPointer(y_), *value = data;
    double *correction = N_VGetArrayPointer(correction_), y[N], g[M], G[M][N], tolerance[M];
    gradients(start, G);
    integrals(start, g);
    double a = 0, b = 0, d = 0;
    for (int i = 0; i < N; ++i)
        y[i] = start[i], a += G[0][i] * G[0][i], b += G[0][i] * G[1][i], d += G[1][i] * G[1][i];
    double determinant = a * d - b * b;
    for (int c = 0; c < M; ++c) {
        g[c] -= value[c], tolerance[c] = fabs(value[c]);
        for (int i = 0; i < N; ++i) tolerance[c] += fabs(G[c][i] * y[i]);
        tolerance[c] *= 4 * DBL_EPSILON;
    }
    for (int count = 0; count < 20; ++count) {
        if (count >= 2 && fabs(g[0]) <= tolerance[0] && fabs(g[1]) <= tolerance[1]) break;
        double first = (d * g[0] - b * g[1]) / determinant;
        double second = (a * g[1] - b * g[0]) / determinant;
        for (int i = 0; i < N; ++i) y[i] -= G[0][i] * first + G[1][i] * second;
        integrals(y, g);
        for (int c = 0; c < M; ++c) g[c] -= value[c];
    }
    if (!(fabs(g[0]) <= tolerance[0] && fabs(g[1]) <= tolerance[1])) return 1; /* a shorter step */
    for (int i = 0; i < N; ++i) correction[i] = y[i] - start[i];
    return 0;
}

/* `state`, in place, from 0 to t1. `method`: CV_ADAMS is 1, CV_BDF 2. Negative if it failed. */
int integrate(double *state, double t1, double tolerance, int method, int projected) {
    SUNContext context;
    if (SUNContext_Create(SUN_COMM_NULL, &context)) return -1;
    N_Vector y = N_VMake_Serial(N, state, context);
    SUNNonlinearSolver iteration = SUNNonlinSol_FixedPoint(y, 0, context);
    void *cvode = CVodeCreate(method, context);
    double value[M], t = 0;
    integrals(state, value);
    int flag = CVodeInit(cvode, right_hand_side, 0.0, y);
    flag |= CVodeSStolerances(cvode, tolerance, tolerance);
    flag |= CVodeSetNonlinearSolver(cvode, iteration);
    flag |= CVodeSetMaxNumSteps(cvode, 100000000);
    flag |= CVodeSetStopTime(cvode, t1); /* onto it, since an interpolated state is not projected */
    flag |= CVodeSetUserData(cvode, value);
    if (projected) flag |= CVodeSetProjFn(cvode, project);
    if (!flag) flag = CVode(cvode, t1, y, &t, CV_NORMAL);
    CVodeFree(&cvode);
    SUNNonlinSolFree(iteration);
    N_VDestroy(y);
    SUNContext_Free(&context);
    return flag;
}
