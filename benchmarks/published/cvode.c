/* CVODE's BDF with Newton's method, dense matrices and a projection in closed form, on the pendulum
   (-DPENDULUM) and on the particle on a circle (-DPARTICLE) of SUNDIALS' own examples. For SUNDIALS
   6 and 7; `sundials.py` calls it. */

#include <cvode/cvode.h>
#include <math.h>
#include <nvector/nvector_serial.h>
#include <sundials/sundials_context.h>
#include <sundials/sundials_version.h>
#include <sunlinsol/sunlinsol_dense.h>
#include <sunmatrix/sunmatrix_dense.h>

#if SUNDIALS_VERSION_MAJOR < 7
#define SUN_COMM_NULL NULL
#endif

#ifdef PENDULUM
enum { N = 4 };
static const double GRAVITY = 13.750371636040746;

static void rates(const double *y, double *f) {
    double tension = y[2] * y[2] + y[3] * y[3] - GRAVITY * y[1];
    f[0] = y[2], f[1] = y[3], f[2] = -tension * y[0], f[3] = -tension * y[1] - GRAVITY;
}
#else
enum { N = 2 };

static void rates(const double *y, double *f) { f[0] = -y[1], f[1] = y[0]; }
#endif

static int right_hand_side(sunrealtype t, N_Vector y, N_Vector f, void *data) {
    (void)t, (void)data;
    rates(N_VGetArrayPointer(y), N_VGetArrayPointer(f));
    return 0;
}

#ifdef TRANSPOSED
/* The Jacobian of the particle as SUNDIALS' example has it: transposed. */
static int jacobian(sunrealtype t, N_Vector y, N_Vector f, SUNMatrix matrix, void *data,
                    N_Vector a, N_Vector b, N_Vector c) {
    (void)t, (void)y, (void)f, (void)data, (void)a, (void)b, (void)c;
    SM_ELEMENT_D(matrix, 0, 1) = 1, SM_ELEMENT_D(matrix, 1, 0) = -1;
    return 0;
}
#endif

/* The part of `v` along the tangent of the circle at the unit vector `q`. */
static void tangential(const double *q, double *v) {
    double along = q[0] * v[1] - q[1] * v[0];
    v[0] = -q[1] * along, v[1] = q[0] * along;
}

/* `correction`: what brings y onto the circle, and its velocity along it. The error estimate, if
   there is one, loses what the projection takes away. */
static int project(sunrealtype t, N_Vector y_, N_Vector correction_, sunrealtype eps,
                   N_Vector error_, void *data) {
    (void)t, (void)eps, (void)data;
    const double *y = N_VGetArrayPointer(y_);
    double *correction = N_VGetArrayPointer(correction_), new[N];
    double radius = sqrt(y[0] * y[0] + y[1] * y[1]);
    for (int i = 0; i < N; ++i) new[i] = y[i];
    new[0] /= radius, new[1] /= radius;
    for (int i = 2; i < N; i += 2) tangential(new, new + i);
    for (int i = 0; i < N; ++i) correction[i] = new[i] - y[i];
    if (error_)
        for (int i = 0; i < N; i += 2) tangential(new, N_VGetArrayPointer(error_) + i);
    return 0;
}

/* `state`, in place, from 0 to t1; `counts`: steps, evaluations, those for Jacobians. Negative if
   it failed. */
int integrate(double *state, double t1, double rtol, double atol, int projected, int error_too,
              long *counts) {
    SUNContext context;
    if (SUNContext_Create(SUN_COMM_NULL, &context)) return -1;
    N_Vector y = N_VMake_Serial(N, state, context);
    SUNMatrix matrix = SUNDenseMatrix(N, N, context);
    SUNLinearSolver linear = SUNLinSol_Dense(y, matrix, context);
    void *cvode = CVodeCreate(CV_BDF, context);
    double t = 0;
    int flag = CVodeInit(cvode, right_hand_side, 0.0, y);
    flag |= CVodeSStolerances(cvode, rtol, atol);
    flag |= CVodeSetLinearSolver(cvode, linear, matrix);
#ifdef TRANSPOSED
    flag |= CVodeSetJacFn(cvode, jacobian);
#endif
    flag |= CVodeSetMaxNumSteps(cvode, 1000000);
    flag |= CVodeSetStopTime(cvode, t1);
    if (projected) flag |= CVodeSetProjFn(cvode, project) | CVodeSetProjErrEst(cvode, error_too);
    if (!flag) flag = CVode(cvode, t1, y, &t, CV_NORMAL);
    CVodeGetNumSteps(cvode, counts);
    CVodeGetNumRhsEvals(cvode, counts + 1);
    CVodeGetNumLinRhsEvals(cvode, counts + 2);
    CVodeFree(&cvode);
    SUNLinSolFree(linear);
    SUNMatDestroy(matrix);
    N_VDestroy(y);
    SUNContext_Free(&context);
    return flag;
}
