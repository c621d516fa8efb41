/* As tube_fit.py: robust Gauss-Newton steps, from coarse to fine. */

#include "kernel.h"

static const double SCHEDULE[] = {16.0, 10.0, 6.0, 4.0, 2.5, 1.6, 1.0, 1.0, 1.0};
enum { SCHEDULED = sizeof SCHEDULE / sizeof *SCHEDULE, MORE_STEPS = 6, SETTLED = 6 };
static const double STILL_M = 1e-4, STILL_SHARE = 3e-4, LEAST_WIDTH = 0.15, LEAST_HOLD = 1e-9;
static const double SCATTER_POINTS[] = {0.7, 3.0}, SCATTER_RAYS[] = {0.5, 2.0};


/* The step, in place of `target`; in place of `normal` its lower factor (Cholesky), whose diagonal is
   inverted. False if it has none. */
int solve_held(struct equations *sums) {
    int64_t size = sums->size, stride = sums->stride;
    double *normal = sums->normal, *target = sums->target, mean = 0;
    for (int k = 0; k < BODY; k++) mean += normal[(stride + 1) * k] / BODY;
    for (int k = 0; k < BODY; k++) normal[(stride + 1) * k] += LEAST_HOLD * mean;
    for (int64_t i = 0; i < size; i++) {
        double *row = normal + stride * i;
        for (int64_t j = 0; j < i; j++)
            row[j] = (row[j] - dot(row, normal + stride * j, j)) * normal[(stride + 1) * j];
        double pivot = row[i] - dot(row, row, i);
        if (!(pivot > 0)) return 0;
        row[i] = 1 / sqrt(pivot);
        target[i] = (target[i] - dot(row, target, i)) * row[i];
    }
    for (int64_t i = size - 1; i >= 0; i--) {
        target[i] *= normal[(stride + 1) * i];
        for (int64_t j = 0; j < i; j++) target[j] -= normal[stride * i + j] * target[i];
    }
    return 1;
}

/* The inverse's first BODY rows and columns, from the factor: the sum of squares of its inverse. */
static void invert(const struct equations *sums, double *inverse, double *covariance) {
    int64_t size = sums->size, stride = sums->stride;
    memset(inverse, 0, sizeof(double) * size * BODY);
    memset(covariance, 0, sizeof(double) * BODY * BODY);
    for (int64_t i = 0; i < size; i++) {
        double *row = inverse + BODY * i;
        const double *factor = sums->normal + stride * i;
        if (i < BODY) row[i] = 1;
        for (int64_t j = 0; j < i; j++)
            for (int k = 0; k < BODY; k++) row[k] -= factor[j] * inverse[BODY * j + k];
        for (int k = 0; k < BODY; k++) row[k] *= factor[i];
        for (int k = 0; k < BODY; k++)
            for (int j = 0; j < BODY; j++) covariance[BODY * k + j] += row[k] * row[j];
    }
}

void stepped(struct shape *shape, double *move, int64_t size) {
    double limit = 0, largest = 0, sorted[WIDTH];
    for (int k = 0; k < WIDTH; k++) limit = larger(limit, fabs(shape->width_m[k]));
    for (int k = 0; k < BODY; k++) largest = larger(largest, fabs(move[k]));
    double times = smaller(1, (0.6 * limit + 0.002) / larger(largest, 1e-12));
    for (int64_t k = 0; k < size; k++) move[k] *= times;
    for (int k = 0; k < BENDS; k++) shape->bend_m[k] += move[k];
    for (int k = 0; k < WIDTH; k++) shape->width_m[k] += move[BENDS + k];
    double least = LEAST_WIDTH * median_of(shape->width_m, WIDTH, sorted);
    for (int k = 0; k < WIDTH; k++) shape->width_m[k] = larger(shape->width_m[k], least);
}

int fit_shape(const struct bases *bases, const struct evidence *seen, struct shape *shape,
              double *nuisance, struct readings *points, struct readings *rays, struct equations *sums,
              double *covariance, int64_t *seen_ends, double *total_misfit) {
    struct balls at;
    balls(bases, shape, &at);
    double anchors_m[6] = {at.x[0], at.y[0], at.z[0], at.x[BALLS - 1], at.y[BALLS - 1], at.z[BALLS - 1]};
    double scatters[2] = {1, 1}, hold[2], length = 0;
    bool settled = false;
    int still = 0;
    seen_ends[0] = seen_ends[1] = 1;
    end_hold(seen_ends, hold);
    for (int step = 0; step < SCHEDULED + MORE_STEPS; step++) {
        if (settled && step >= SCHEDULED) break;
        double scale = SCHEDULE[step < SCHEDULED ? step : SCHEDULED - 1], largest = 0;
        point_readings(bases, seen, shape, nuisance, points);
        ray_readings(bases, seen, shape, nuisance, rays);
        if (step >= SETTLED) {
            scatters[0] = scatter(points, seen->points, SCATTER_POINTS[0], SCATTER_POINTS[1]);
            scatters[1] = scatter(rays, seen->rays, SCATTER_RAYS[0], SCATTER_RAYS[1]);
            ends_seen(bases, shape, seen->rays, seen->rays_m, rays, seen_ends);
            end_hold(seen_ends, hold);
        }
        normal_equations(bases, seen, points, rays, scatters, scale, sums);
        add_shape_prior(bases, shape, anchors_m, hold, sums);
        add_nuisance_prior(seen, nuisance, sums);
        if (!solve_held(sums)) return 0;
        for (int k = 0; k < SHAPE; k++) largest = larger(largest, fabs(sums->target[k]));
        settled = largest < STILL_M;
        stepped(shape, sums->target, sums->size);
        balls(bases, shape, &at);
        double before = length;
        length = length_m(&at);
        if (!isfinite(length)) return 0;
        if (step >= SETTLED) {
            still = fabs(length - before) < STILL_SHARE * length ? still + 1 : 0;
            settled = settled || still > 1;
        } else {
            length = 0;
        }
        for (int64_t k = 0; k < sums->size - SHAPE; k++) nuisance[k] += sums->target[SHAPE + k];
    }
    ray_readings(bases, seen, shape, nuisance, rays);
    point_readings(bases, seen, shape, nuisance, points);
    *total_misfit = misfit(points, seen->points, seen->points_share) + misfit(rays, seen->rays, seen->rays_share);
    for (int64_t i = 0; i < seen->points; i++)
        points->gap_m[i] -= points->facing[i] * dot(waves_of(seen, i), nuisance + SLIPS, seen->waves);
    invert(sums, sums->rows, covariance);
    ends_seen(bases, shape, seen->rays, seen->rays_m, rays, seen_ends);
    return isfinite(*total_misfit);
}
