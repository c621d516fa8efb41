/* As tube_prior.py: how a fruit bends, tilts and grows thick, and how large errors are. */

#include "kernel.h"

static const double TWIST_SD = 1.0, BEND_SD = 8.0, BEND_CHANGE_SD = 100.0, TILT_SD = 0.6, SPEED_SD = 0.02;
static const double WIDTH_SD = 0.05, WIDTH_TAIL = 1.0, ANCHOR_SD = 1.5, HIDDEN_ANCHOR_SD = 0.15;
static const double SLIP_SD_PX[SLIPS] = {1.0, 1.0, 0.1};
static const double SECOND[3] = {1, -2, 1}, THIRD[4] = {-1, 3, -3, 1};

void end_hold(const int64_t *visible, double *hold) {
    for (int end = 0; end < 2; end++) hold[end] = visible[end] ? ANCHOR_SD : HIDDEN_ANCHOR_SD;
}

/* Add to the lower triangle what squared sums of `count` unknowns from `first` on, `apart` from each
   other, say. */
static void add_square(const double *row, int count, int first, int apart, struct equations *sums) {
    for (int i = 0; i < count; i++)
        for (int j = 0; j <= i; j++)
            sums->normal[sums->stride * (first + apart * i) + first + apart * j] += row[i] * row[j];
}

/* Add that a sum of one coordinate's control points is about `pull`, for each coordinate alike. */
static void add_same(const double *row, int count, int first, const double *pull, const double *bend_m,
                     struct equations *sums) {
    for (int axis = 0; axis < 3; axis++) {
        double sum = pull ? -pull[axis] : 0;
        for (int j = 0; j < count; j++) sum += row[j] * bend_m[3 * (first + j) + axis];
        for (int j = 0; j < count; j++) sums->target[3 * (first + j) + axis] -= row[j] * sum;
        add_square(row, count, 3 * first + axis, 3, sums);
    }
}

/* Add that a sum of all the curve's unknowns is about 0. */
static void add_even(const double *row, const double *bend_m, struct equations *sums) {
    double sum = 0;
    for (int j = 0; j < BENDS; j++) sum += row[j] * bend_m[j];
    for (int j = 0; j < BENDS; j++) sums->target[j] -= row[j] * sum;
    add_square(row, BENDS, 0, 1, sums);
}

void add_shape_prior(const struct bases *bases, const struct shape *shape, const double *anchors_m,
                     const double *anchors_sd, struct equations *sums) {
    const double *bend = shape->bend_m, *width = shape->width_m;
    double step = 0, sorted[WIDTH], radius = larger(median_of(width, WIDTH, sorted), 0.002);
    for (int k = 1; k < BEND; k++) {
        double x = bend[3 * k] - bend[3 * k - 3], y = bend[3 * k + 1] - bend[3 * k - 2];
        double z = bend[3 * k + 2] - bend[3 * k - 1];
        step += sqrt(x * x + y * y + z * z);
    }
    step /= BEND - 1;
    double twist_sd = smaller(TWIST_SD * step / (BEND_SEGMENTS * BEND_SEGMENTS),
                              BEND_CHANGE_SD * step * step * step);
    double row[BENDS];
    for (int k = 0; k < BEND - 3; k++) {
        for (int j = 0; j < 4; j++) row[j] = THIRD[j] / twist_sd;
        add_same(row, 4, k, NULL, bend, sums);
    }
    for (int k = 0; k < BEND - 2; k++) {
        for (int j = 0; j < 3; j++) row[j] = SECOND[j] / (BEND_SD * step * step);
        add_same(row, 3, k, NULL, bend, sums);
    }
    const double *ends[2] = {bases->bend_balls, bases->bend_balls + BEND * (BALLS - 1)};
    for (int end = 0; end < 2; end++) {
        double held = anchors_sd[end] * radius, pull[3];
        for (int axis = 0; axis < 3; axis++) pull[axis] = anchors_m[3 * end + axis] / held;
        for (int j = 0; j < BEND; j++) row[j] = ends[end][j] / held;
        add_same(row, BEND, 0, pull, bend, sums);
    }
    /* Control points keep their distances: nothing else tells where along the curve they sit. */
    for (int k = 0; k < BEND - 2; k++) {
        double tangent[3];
        for (int axis = 0; axis < 3; axis++) tangent[axis] = bend[3 * k + 6 + axis] - bend[3 * k + axis];
        double norm = larger(sqrt(dot3(tangent, tangent)), 1e-9);
        memset(row, 0, sizeof row);
        for (int j = 0; j < 3; j++)
            for (int axis = 0; axis < 3; axis++)
                row[3 * (k + j) + axis] = SECOND[j] * (tangent[axis] / norm / (SPEED_SD * step));
        add_even(row, bend, sums);
    }
    /* Where depth hardly tells, a fruit rather lies across the view than along it. */
    double middle[3] = {0};
    for (int k = 0; k < BEND; k++)
        for (int axis = 0; axis < 3; axis++) middle[axis] += bend[3 * k + axis] / BEND;
    double norm = sqrt(dot3(middle, middle)) * TILT_SD * step * BEND_SEGMENTS;
    for (int j = 0; j < BENDS; j++) row[j] = (ends[1][j / 3] - ends[0][j / 3]) * (middle[j % 3] / norm);
    add_even(row, bend, sums);
    for (int k = 0; k < WIDTH - 2; k++) {
        double rough = 0, sum = 0;
        for (int j = 0; j < 3; j++) rough += SECOND[j] / (WIDTH_SD * radius) * width[k + j];
        double tail = sqrt(1 + (rough / WIDTH_TAIL) * (rough / WIDTH_TAIL));
        for (int j = 0; j < 3; j++) row[j] = SECOND[j] / (WIDTH_SD * radius) / tail;
        for (int j = 0; j < 3; j++) sum += row[j] * width[k + j];
        for (int j = 0; j < 3; j++) sums->target[BENDS + k + j] -= row[j] * sum;
        add_square(row, 3, BENDS + k, 1, sums);
    }
}

void add_nuisance_prior(const struct evidence *seen, const double *nuisance, struct equations *sums) {
    for (int64_t k = 0; k < SLIPS + seen->waves; k++) {
        double sd = k < SLIPS ? SLIP_SD_PX[k] * seen->slip_m : 1;
        sums->normal[(sums->stride + 1) * (SHAPE + k)] += 1 / (sd * sd);
        sums->target[SHAPE + k] -= nuisance[k] / (sd * sd);
    }
}
