/* M6's fit in C: the functions of tube_gaps.py, tube_evidence.py, tube_prior.py and tube_fit.py, under
   the same names and in the same order. NumPy's are the reference, and explain what each one does.

   Nothing is allocated here and nothing is checked: tube_kernel.py does both. Arrays are contiguous, row
   by row, float64. Sums have a fixed order, so that every processor gives the same length. */

#ifndef CUCUMBERVISION_KERNEL_H
#define CUCUMBERVISION_KERNEL_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum {
    BEND_SEGMENTS = 4,
    WIDTH_SEGMENTS = 12,
    BEND = BEND_SEGMENTS + 3,
    WIDTH = WIDTH_SEGMENTS + 3,
    BENDS = 3 * BEND,
    SHAPE = BENDS + WIDTH,
    SLIPS = 3,
    BODY = SHAPE + SLIPS,
    BALLS = 64,
    FINE = 1024,
    TILE = 4 /* unknowns that are summed at once; the waves are padded to a multiple of it */
};

/* bases(BALLS) and bases(FINE + 1) of tube.py. */
struct bases {
    const double *bend_balls, *width_balls, *bend_fine, *width_fine;
};

/* TubeShape: control points (BEND, 3) and radii (WIDTH). */
struct shape {
    double *bend_m, *width_m;
};

/* Evidence, with `directions`, `points_far_m` and `far_m` of it; rows of `waves_m` are padded with zeros. */
struct evidence {
    int64_t points, rays, waves;
    const double *points_m, *directions, *points_far_m, *points_sd_m, *rays_m, *waves_m;
    double rays_sd_rad, points_share, rays_share, slip_m, far_m;
};

static inline int64_t padded(int64_t waves) { return (waves + TILE - 1) / TILE * TILE; }
static inline const double *waves_of(const struct evidence *seen, int64_t i) {
    return seen->waves_m + padded(seen->waves) * i;
}

/* Readings with their Gaps: index is the share times FINE, and tells the bases; `facing` is of
   depth points, `by_far` of the outline. `scratch` has as many numbers as there are readings. */
struct readings {
    double *gap_m, *away, *centres_m, *facing, *sd_m, *scratch;
    int64_t *index;
};

/* Normal equations. `normal` has `stride` rows and columns, of which only the lower triangle of the
   first BODY + waves is used. `rows` has room for ROWS of `stride` numbers. */
enum { ROWS = 48 };
struct equations {
    int64_t size, stride;
    double *normal, *target, *rows;
};

/* The balls of a shape, coordinate by coordinate. */
struct balls {
    double x[BALLS], y[BALLS], z[BALLS], squared[BALLS], radius[BALLS];
};

static inline double smaller(double a, double b) { return a < b ? a : b; }
static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double dot3(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Four sums, so that no addition waits for the one before it. */
static inline double dot(const double *a, const double *b, int64_t count) {
    double sums[4] = {0};
    int64_t k = 0;
    for (; k + 4 <= count; k += 4)
        for (int j = 0; j < 4; j++) sums[j] += a[k + j] * b[k + j];
    for (; k < count; k++) sums[0] += a[k] * b[k];
    return sums[0] + sums[1] + (sums[2] + sums[3]);
}

/* tube.py */
void balls(const struct bases *bases, const struct shape *shape, struct balls *found);
double length_m(const struct balls *at);

/* tube_gaps.py */
void gaps(const struct bases *bases, const struct shape *shape, int64_t count, const double *readings,
          int64_t rays, struct readings *found);
void depth_gaps(const struct bases *bases, const struct shape *shape, int64_t count, const double *rays,
                const double *far_m, struct readings *found);

/* tube_evidence.py */
void point_readings(const struct bases *bases, const struct evidence *seen, const struct shape *shape,
                    const double *nuisance, struct readings *found);
void ray_readings(const struct bases *bases, const struct evidence *seen, const struct shape *shape,
                  const double *slip_m, struct readings *found);
double misfit(const struct readings *read, int64_t count, double share);
double scatter(const struct readings *read, int64_t count, double least, double most);
void normal_equations(const struct bases *bases, const struct evidence *seen,
                      const struct readings *points, const struct readings *rays,
                      const double *scatters, double scale, struct equations *sums);
double median_of(const double *values, int64_t count, double *scratch);
void ends_seen(const struct bases *bases, const struct shape *shape, int64_t count,
               const double *rays, const struct readings *read, int64_t *seen);

/* tube_prior.py */
void end_hold(const int64_t *visible, double *hold);
void add_shape_prior(const struct bases *bases, const struct shape *shape, const double *anchors_m,
                     const double *anchors_sd, struct equations *sums);
void add_nuisance_prior(const struct evidence *seen, const double *nuisance, struct equations *sums);

/* tube_fit.py */
int solve_held(struct equations *sums);
void stepped(struct shape *shape, double *move, int64_t size);
int fit_shape(const struct bases *bases, const struct evidence *seen, struct shape *shape,
              double *nuisance, struct readings *points, struct readings *rays, struct equations *sums,
              double *covariance, int64_t *seen_ends, double *total_misfit);

#endif
