// Copyright 2026 rs_localizer contributors
// SPDX-License-Identifier: Apache-2.0
//
// The routines of BLAS and LAPACK that np.linalg and @ stand for in kernels, under the names that
// Numba calls them by (numba/_lapack.c), for small matrices of doubles stored by columns. Products
// and eigenvalues are Eigen's. All run in one thread: the same bits on every machine of a level.
#include <Eigen/Dense>
#include <cmath>
#include <cstddef>
#include <cstdlib>

#define ROUTINE extern "C" __attribute__((visibility("hidden")))

namespace {
using Index = ptrdiff_t;
using Matrix = Eigen::Map<Eigen::MatrixXd, 0, Eigen::OuterStride<>>;
using Vector = Eigen::Map<Eigen::VectorXd>;

// Below this sum of sizes Eigen's blocked product costs more than it saves (its own threshold is 20).
constexpr Index SMALL = 24;
constexpr int WRONG_KIND = -1;

Matrix at(void *data, Index rows, Index columns, Index step) {
    return Matrix(static_cast<double *>(data), rows, columns, Eigen::OuterStride<>(step));
}
bool is(char given, char wanted) { return (given | 32) == wanted; }

template <class Left, class Right>
void add_product(Matrix &sum, double factor, const Left &left, const Right &right, bool is_small) {
    if (is_small) sum += factor * left.lazyProduct(right);
    else sum.noalias() += factor * left * right;
}
}  // namespace

ROUTINE int numba_xxgemm(char kind, char turn_a, char turn_b, Index m, Index n, Index k, void *alpha, void *a_data,
                         Index a_step, void *b_data, Index b_step, void *beta, void *c_data, Index c_step) {
    if (kind != 'd') return WRONG_KIND;
    const double factor = *static_cast<double *>(alpha), kept = *static_cast<double *>(beta);
    const bool a_turned = !is(turn_a, 'n'), b_turned = !is(turn_b, 'n'), is_small = m + n + k < SMALL;
    Matrix a = at(a_data, a_turned ? k : m, a_turned ? m : k, a_step);
    Matrix b = at(b_data, b_turned ? n : k, b_turned ? k : n, b_step);
    Matrix c = at(c_data, m, n, c_step);
    if (kept == 0.0) c.setZero();
    else if (kept != 1.0) c *= kept;
    if (a_data == b_data && a_step == b_step && a_turned != b_turned && m == n && kept == 0.0 && !is_small) {
        auto half = c.selfadjointView<Eigen::Lower>();  // of a matrix and itself: half of the work
        if (a_turned) half.rankUpdate(a.transpose(), factor);
        else half.rankUpdate(a, factor);
        c.triangularView<Eigen::StrictlyUpper>() = c.transpose();
        return 0;
    }
    if (a_turned && b_turned) add_product(c, factor, a.transpose(), b.transpose(), is_small);
    else if (a_turned) add_product(c, factor, a.transpose(), b, is_small);
    else if (b_turned) add_product(c, factor, a, b.transpose(), is_small);
    else add_product(c, factor, a, b, is_small);
    return 0;
}

ROUTINE int numba_xxgemv(char kind, char turn, Index m, Index n, void *alpha, void *a_data, Index step, void *x_data,
                         void *beta, void *y_data) {
    if (kind != 'd') return WRONG_KIND;
    const double factor = *static_cast<double *>(alpha), kept = *static_cast<double *>(beta);
    const bool is_turned = !is(turn, 'n');
    Matrix a = at(a_data, m, n, step);
    Vector x(static_cast<double *>(x_data), is_turned ? m : n), y(static_cast<double *>(y_data), is_turned ? n : m);
    if (kept == 0.0) y.setZero();
    else if (kept != 1.0) y *= kept;
    if (is_turned) y.noalias() += factor * a.transpose() * x;
    else y.noalias() += factor * a * x;
    return 0;
}

ROUTINE int numba_xxdot(char kind, char, Index n, void *x_data, void *y_data, void *result) {
    if (kind != 'd') return WRONG_KIND;
    const double *x = static_cast<double *>(x_data), *y = static_cast<double *>(y_data);
    double sum = 0.0;
    for (Index i = 0; i < n; ++i) sum += x[i] * y[i];
    *static_cast<double *>(result) = sum;
    return 0;
}

// Scaled by the largest entry, so that no square overflows.
ROUTINE int numba_xxnrm2(char kind, Index n, void *x_data, Index step, void *result) {
    if (kind != 'd') return WRONG_KIND;
    const double *x = static_cast<double *>(x_data);
    double largest = 0.0, sum = 0.0;
    bool is_finite = true;
    for (Index i = 0; i < n; ++i) {
        const double size = std::fabs(x[i * step]);
        is_finite = is_finite && std::isfinite(size);
        if (size > largest) largest = size;
    }
    double norm = largest;
    if (!is_finite) {
        norm = 0.0;
        for (Index i = 0; i < n; ++i) norm += std::fabs(x[i * step]);  // infinity, or NaN
    } else if (largest > 0.0) {
        for (Index i = 0; i < n; ++i) sum += (x[i * step] / largest) * (x[i * step] / largest);
        norm = largest * std::sqrt(sum);
    }
    *static_cast<double *>(result) = norm;
    return 0;
}

// LU with partial pivoting, as dgetrf leaves it: both factors in place, rows counted from one.
ROUTINE int numba_xxgetrf(char kind, Index m, Index n, void *data, Index step, int *pivots) {
    if (kind != 'd') return WRONG_KIND;
    double *a = static_cast<double *>(data);
    int info = 0;
    for (Index k = 0; k < (m < n ? m : n); ++k) {
        Index best = k;
        for (Index i = k + 1; i < m; ++i)
            if (std::fabs(a[k * step + i]) > std::fabs(a[k * step + best])) best = i;
        pivots[k] = static_cast<int>(best) + 1;
        if (a[k * step + best] == 0.0) {
            if (!info) info = static_cast<int>(k) + 1;
            continue;
        }
        if (best != k)
            for (Index j = 0; j < n; ++j) std::swap(a[j * step + k], a[j * step + best]);
        const double inverse = 1.0 / a[k * step + k];
        for (Index i = k + 1; i < m; ++i) a[k * step + i] *= inverse;
        for (Index j = k + 1; j < n; ++j) {
            const double x = a[j * step + k];
            for (Index i = k + 1; i < m; ++i) a[j * step + i] -= a[k * step + i] * x;
        }
    }
    return info;
}

namespace {
// Solve L U x = P b in place, for one column.
void solve_column(const double *lu, Index n, Index step, const int *pivots, double *x) {
    for (Index k = 0; k < n; ++k) std::swap(x[k], x[pivots[k] - 1]);
    for (Index k = 0; k < n; ++k)
        for (Index i = k + 1; i < n; ++i) x[i] -= lu[k * step + i] * x[k];
    for (Index k = n - 1; k >= 0; --k) {
        x[k] /= lu[k * step + k];
        for (Index i = 0; i < k; ++i) x[i] -= lu[k * step + i] * x[k];
    }
}
}  // namespace

ROUTINE int numba_ez_xxgetri(char kind, Index n, void *data, Index step, int *pivots) {
    if (kind != 'd') return WRONG_KIND;
    Matrix a = at(data, n, n, step);
    for (Index i = 0; i < n; ++i)
        if (a(i, i) == 0.0) return static_cast<int>(i) + 1;
    const Eigen::MatrixXd lu = a;
    a.setIdentity();
    for (Index j = 0; j < n; ++j) solve_column(lu.data(), n, n, pivots, static_cast<double *>(data) + j * step);
    return 0;
}

ROUTINE int numba_xgesv(char kind, Index n, Index count, void *data, Index step, int *pivots, void *b_data,
                        Index b_step) {
    const int info = numba_xxgetrf(kind, n, n, data, step, pivots);
    if (info) return info;
    for (Index j = 0; j < count; ++j)
        solve_column(static_cast<double *>(data), n, step, pivots, static_cast<double *>(b_data) + j * b_step);
    return 0;
}

ROUTINE int numba_xxpotrf(char kind, char triangle, Index n, void *data, Index step) {
    if (kind != 'd') return WRONG_KIND;
    double *a = static_cast<double *>(data);
    const Index down = is(triangle, 'l') ? 1 : step, right = is(triangle, 'l') ? step : 1;
    for (Index j = 0; j < n; ++j) {
        double pivot = a[j * down + j * right];
        for (Index k = 0; k < j; ++k) pivot -= a[j * down + k * right] * a[j * down + k * right];
        if (!(pivot > 0.0)) return static_cast<int>(j) + 1;
        a[j * down + j * right] = pivot = std::sqrt(pivot);
        for (Index i = j + 1; i < n; ++i) {
            double sum = a[i * down + j * right];
            for (Index k = 0; k < j; ++k) sum -= a[i * down + k * right] * a[j * down + k * right];
            a[i * down + j * right] = sum / pivot;
        }
    }
    return 0;
}

ROUTINE int numba_ez_xxxevd(char kind, char job, char triangle, Index n, void *data, Index step, void *w_data) {
    if (kind != 'd') return WRONG_KIND;
    Matrix a = at(data, n, n, step);
    Eigen::MatrixXd full = a.selfadjointView<Eigen::Upper>();
    if (is(triangle, 'l')) full = a.selfadjointView<Eigen::Lower>();
    if (!full.allFinite()) return 1;
    const bool has_vectors = is(job, 'v');
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver(
        full, has_vectors ? Eigen::ComputeEigenvectors : Eigen::EigenvaluesOnly);
    if (solver.info() != Eigen::Success) return 1;
    Vector(static_cast<double *>(w_data), n) = solver.eigenvalues();
    if (has_vectors) a = solver.eigenvectors();
    return 0;
}
