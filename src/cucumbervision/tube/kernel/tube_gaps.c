/* As tube_gaps.py: distances of readings from balls along a smooth curve. */

#include "kernel.h"

static const double GRAZING = 0.2, MISSED_M = 100.0;
enum { BLOCK = 64 }; /* readings that are compared with all balls at once */

void balls(const struct bases *bases, const struct shape *shape, struct balls *found) {
    for (int k = 0; k < BALLS; k++) {
        const double *bend = bases->bend_balls + BEND * k, *width = bases->width_balls + WIDTH * k;
        double x = 0, y = 0, z = 0, radius = 0;
        for (int j = 0; j < BEND; j++) {
            x += bend[j] * shape->bend_m[3 * j];
            y += bend[j] * shape->bend_m[3 * j + 1];
            z += bend[j] * shape->bend_m[3 * j + 2];
        }
        for (int j = 0; j < WIDTH; j++) radius += width[j] * shape->width_m[j];
        found->x[k] = x, found->y[k] = y, found->z[k] = z, found->radius[k] = radius;
        found->squared[k] = x * x + y * y + z * z;
    }
}

double length_m(const struct balls *at) {
    double sum = 0;
    for (int k = 1; k < BALLS; k++) {
        double x = at->x[k] - at->x[k - 1], y = at->y[k] - at->y[k - 1], z = at->z[k] - at->z[k - 1];
        sum += sqrt(x * x + y * y + z * z);
    }
    return sum + at->radius[0] + at->radius[BALLS - 1];
}

/* Where the parabola through three neighbours is lowest, from the middle one: -1 to 1. */
static double vertex(double a, double b, double c) {
    double curve = a - 2 * b + c, slope = a - c;
    double step = curve > 1e-12 ? 0.5 * slope / curve : (double)((slope > 0) - (slope < 0));
    return smaller(larger(step, -1.0), 1.0);
}

/* Readings of one block, coordinate by coordinate, and the ball that is best for each. */
struct block {
    int count;
    double x[BLOCK], y[BLOCK], z[BLOCK], least[BLOCK], ball[BLOCK];
};

static void put(struct block *block, const double *reading, double times) {
    int j = block->count++;
    block->x[j] = times * reading[0], block->y[j] = times * reading[1], block->z[j] = times * reading[2];
    block->least[j] = INFINITY, block->ball[j] = 0;
}

static void keep_least(struct block *block, const double *values, int ball) {
    for (int j = 0; j < block->count; j++) {
        bool less = values[j] < block->least[j];
        block->ball[j] = less ? (double)ball : block->ball[j];
        block->least[j] = less ? values[j] : block->least[j];
    }
}

static double distance(const struct balls *at, int k, double x, double y, double z, double own, int rays) {
    double along = x * at->x[k] + y * at->y[k] + z * at->z[k];
    double squared = rays ? at->squared[k] - along * along : at->squared[k] - 2 * along + own;
    return sqrt(squared > 0 ? squared : 0) - at->radius[k];
}

/* Fractional balls to which the readings of a block are nearest, in place of `ball`. */
static void lowest(const struct balls *at, struct block *block, int rays) {
    double own[BLOCK], values[BLOCK];
    for (int j = 0; j < block->count; j++)
        own[j] = block->x[j] * block->x[j] + block->y[j] * block->y[j] + block->z[j] * block->z[j];
    for (int k = 0; k < BALLS; k++) {
        if (rays)
            for (int j = 0; j < block->count; j++)
                values[j] = distance(at, k, block->x[j], block->y[j], block->z[j], own[j], 1);
        else
            for (int j = 0; j < block->count; j++)
                values[j] = distance(at, k, block->x[j], block->y[j], block->z[j], own[j], 0);
        keep_least(block, values, k);
    }
    for (int j = 0; j < block->count; j++) {
        int k = (int)smaller(larger(block->ball[j], 1), BALLS - 2);
        double near[3];
        for (int side = 0; side < 3; side++)
            near[side] = distance(at, k + side - 1, block->x[j], block->y[j], block->z[j], own[j], rays);
        block->ball[j] = k + vertex(near[0], near[1], near[2]);
    }
}

/* Balls that the rays of a block enter first, and how far away; MISSED_M where they enter none. */
static void entered(const struct balls *at, struct block *block) {
    double values[BLOCK], inside[BLOCK];
    for (int j = 0; j < block->count; j++) block->least[j] = MISSED_M;
    for (int k = 0; k < BALLS; k++) {
        double reach = at->radius[k] * fabs(at->radius[k]) - at->squared[k];
        int64_t hits = 0;
        for (int j = 0; j < block->count; j++) {
            values[j] = block->x[j] * at->x[k] + block->y[j] * at->y[k] + block->z[j] * at->z[k];
            inside[j] = values[j] * values[j] + reach;
            hits += inside[j] > 0;
        }
        if (!hits) continue;
        for (int j = 0; j < block->count; j++) {
            double root = sqrt(inside[j] > 0 ? inside[j] : 0);
            values[j] = inside[j] > 0 ? values[j] - root : MISSED_M;
        }
        keep_least(block, values, k);
    }
}

/* Index among FINE positions, and centre and radius there, at a fractional ball. */
static double ball_at(const struct bases *bases, const struct shape *shape, double ball, int64_t *index,
                      double *centre) {
    int64_t i = lrint(ball * ((double)FINE / (BALLS - 1)));
    *index = i = i < 0 ? 0 : i > FINE ? FINE : i;
    const double *bend = bases->bend_fine + BEND * i, *width = bases->width_fine + WIDTH * i;
    double radius = 0;
    centre[0] = centre[1] = centre[2] = 0;
    for (int j = 0; j < BEND; j++)
        for (int axis = 0; axis < 3; axis++) centre[axis] += bend[j] * shape->bend_m[3 * j + axis];
    for (int j = 0; j < WIDTH; j++) radius += width[j] * shape->width_m[j];
    return radius;
}

/* The gap of one reading of a block whose nearest ball is known. */
static void measure(const struct bases *bases, const struct shape *shape, const struct block *block, int j,
                    int rays, int64_t i, struct readings *found) {
    double *centre = found->centres_m + 3 * i, *away = found->away + 3 * i;
    double radius = ball_at(bases, shape, block->ball[j], found->index + i, centre);
    double reading[3] = {block->x[j], block->y[j], block->z[j]}, squared = 0;
    double along = centre[0] * reading[0] + centre[1] * reading[1] + centre[2] * reading[2];
    for (int axis = 0; axis < 3; axis++) {
        away[axis] = centre[axis] - (rays ? along : 1) * reading[axis];
        squared += away[axis] * away[axis];
    }
    double norm = larger(sqrt(squared), 1e-9);
    for (int axis = 0; axis < 3; axis++) away[axis] /= norm;
    found->gap_m[i] = norm - radius;
}

void gaps(const struct bases *bases, const struct shape *shape, int64_t count, const double *readings,
          int64_t rays, struct readings *found) {
    struct balls at;
    balls(bases, shape, &at);
    for (int64_t first = 0; first < count; first += BLOCK) {
        struct block block = {.count = 0};
        for (int64_t i = first; i < count && i < first + BLOCK; i++) put(&block, readings + 3 * i, 1);
        lowest(&at, &block, rays);
        for (int j = 0; j < block.count; j++) measure(bases, shape, &block, j, rays, first + j, found);
    }
}

/* Where one ray enters the body, from the ball that it enters first. */
static void enter(const struct bases *bases, const struct shape *shape, const struct balls *at,
                  const struct block *block, int j, double far_m, int64_t i, struct readings *found) {
    double ray[3] = {block->x[j], block->y[j], block->z[j]}, first = block->least[j], near[3];
    int nearest = (int)smaller(larger(block->ball[j], 1), BALLS - 2);
    for (int side = 0; side < 3; side++) {
        int k = nearest + side - 1;
        double x = at->x[k] - first * ray[0], y = at->y[k] - first * ray[1], z = at->z[k] - first * ray[2];
        near[side] = sqrt(x * x + y * y + z * z) - at->radius[k];
    }
    double *centre = found->centres_m + 3 * i, *away = found->away + 3 * i;
    double ball = nearest + vertex(near[0], near[1], near[2]);
    double radius = larger(ball_at(bases, shape, ball, found->index + i, centre), 1e-4);
    double along = centre[0] * ray[0] + centre[1] * ray[1] + centre[2] * ray[2];
    double squared = centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2] - along * along;
    double facing = sqrt(smaller(larger(1 - squared / (radius * radius), 0), 1));
    double entry = along - facing * radius;
    for (int axis = 0; axis < 3; axis++) away[axis] = (centre[axis] - entry * ray[axis]) / radius;
    found->gap_m[i] = (entry - far_m) * facing;
    found->facing[i] = facing;
}

void depth_gaps(const struct bases *bases, const struct shape *shape, int64_t count, const double *rays,
                const double *far_m, struct readings *found) {
    struct balls at;
    balls(bases, shape, &at);
    for (int64_t first = 0; first < count; first += BLOCK) {
        struct block block = {.count = 0}, missed = {.count = 0};
        int64_t number[BLOCK];
        for (int64_t i = first; i < count && i < first + BLOCK; i++) put(&block, rays + 3 * i, 1);
        entered(&at, &block);
        for (int j = 0; j < block.count; j++) {
            int64_t i = first + j;
            enter(bases, shape, &at, &block, j, far_m[i], i, found);
            if (found->facing[i] > GRAZING) continue;
            number[missed.count] = i;
            put(&missed, rays + 3 * i, far_m[i]);
        }
        lowest(&at, &missed, 0);
        for (int j = 0; j < missed.count; j++) measure(bases, shape, &missed, j, 0, number[j], found);
    }
}
