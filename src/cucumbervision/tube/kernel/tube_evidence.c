/* As tube_evidence.py: residuals, errors and derivatives of the readings, and their normal equations. */

#include "kernel.h"

static const double TUKEY = 4.685, CAUCHY = 2.385, TIP_COSINE = 0.7;
static const double GROUND_M = 0.0003, ACROSS = 0.3, MISFIT_SD = 5.0;
static const double NEGLIGIBLE_M = 1e-15; /* a wave far from a reading does no more than that there */
enum { TIP_RAYS = 2, LOCAL = 4 * (3 + 1) }; /* four control points weigh in a ball: bend and width */


void point_readings(const struct bases *bases, const struct evidence *seen, const struct shape *shape,
                    const double *nuisance, struct readings *found) {
    depth_gaps(bases, shape, seen->points, seen->directions, seen->points_far_m, found);
    for (int64_t i = 0; i < seen->points; i++) {
        double facing = found->facing[i], by_depth = seen->points_sd_m[i] * facing;
        double across = ACROSS * seen->rays_sd_rad * seen->points_m[3 * i + 2];
        found->sd_m[i] = sqrt(by_depth * by_depth + across * across + GROUND_M * GROUND_M);
        found->gap_m[i] += facing * dot(waves_of(seen, i), nuisance + SLIPS, seen->waves);
    }
}

void ray_readings(const struct bases *bases, const struct evidence *seen, const struct shape *shape,
                  const double *slip_m, struct readings *found) {
    gaps(bases, shape, seen->rays, seen->rays_m, 1, found);
    for (int64_t i = 0; i < seen->rays; i++) {
        const double *centre = found->centres_m + 3 * i, *away = found->away + 3 * i;
        double far_m = sqrt(dot3(centre, centre)), across = seen->rays_sd_rad * far_m;
        found->sd_m[i] = sqrt(across * across + GROUND_M * GROUND_M);
        found->facing[i] = far_m / seen->far_m;
        found->gap_m[i] += found->facing[i] * (away[0] * slip_m[0] + away[1] * slip_m[1] - slip_m[2]);
    }
}

double misfit(const struct readings *read, int64_t count, double share) {
    double sum = 0;
    for (int64_t i = 0; i < count; i++) {
        double off = smaller(fabs(read->gap_m[i] / read->sd_m[i]), MISFIT_SD);
        sum += off * off;
    }
    return share * sum;
}

double scatter(const struct readings *read, int64_t count, double least, double most) {
    if (!count) return 1;
    for (int64_t i = 0; i < count; i++) read->scratch[i] = fabs(read->gap_m[i] / read->sd_m[i]);
    return smaller(larger(1.4826 * median_of(read->scratch, count, read->scratch), least), most);
}

/* Add a tile of the rows' products, TILE unknowns by TILE unknowns, to normal equations. */
typedef double pair __attribute__((vector_size(16)));

static void add_tile(const double *rows, int64_t count, int64_t width, int64_t p, int64_t q,
                     double *normal, int64_t stride) {
    pair sum[TILE][2] = {{{0}}};
    for (int64_t i = 0; i < count; i++) {
        const double *a = rows + width * i + p, *b = rows + width * i + q;
        pair low = {b[0], b[1]}, high = {b[2], b[3]};
        for (int r = 0; r < TILE; r++) {
            pair both = {a[r], a[r]};
            sum[r][0] += both * low;
            sum[r][1] += both * high;
        }
    }
    for (int r = 0; r < TILE; r++)
        for (int c = 0; c < TILE; c++) normal[stride * r + c] += sum[r][c / 2][c % 2];
}

/* Add rows of one segment, whose tiles of unknowns begin at `place`; only those that are used. */
static void add_rows(const double *rows, int64_t count, int64_t tiles, const int64_t *place,
                     const bool *used, struct equations *sums) {
    for (int64_t p = 0; p < tiles; p++)
        for (int64_t q = 0; q <= p && used[p]; q++)
            if (used[q])
                add_tile(rows, count, TILE * tiles, TILE * p, TILE * q,
                         sums->normal + sums->stride * place[p] + place[q], sums->stride);
}

static double tukey(double u) {
    double inside = larger(1 - (u / TUKEY) * (u / TUKEY), 0);
    return inside * inside;
}

static double cauchy(double u) { return 1 / (1 + (u / CAUCHY) * (u / CAUCHY)); }

/* The derivatives of a reading by the unknowns that matter to it, times a weight: four control points
   and four radii, then the waves (depth points), or the slips (outline). */
static void slope(const struct bases *bases, const struct readings *read, int64_t i, int64_t segment,
                  double weight, double *row) {
    const double *bend = bases->bend_fine + BEND * read->index[i] + segment * BEND_SEGMENTS / WIDTH_SEGMENTS;
    const double *width = bases->width_fine + WIDTH * read->index[i] + segment;
    for (int j = 0; j < 4; j++) {
        for (int axis = 0; axis < 3; axis++) row[3 * j + axis] = weight * bend[j] * read->away[3 * i + axis];
        row[12 + j] = -weight * width[j];
    }
}

/* The width's segment, which tells the bend's: one has three of the other. */
static int64_t segment_of(int64_t index) {
    return index < FINE ? index * WIDTH_SEGMENTS / FINE : WIDTH_SEGMENTS - 1;
}

static void add_kind(const struct bases *bases, const struct evidence *seen, const struct readings *read,
                     bool is_rays, double share, double by, struct equations *sums) {
    int64_t count = is_rays ? seen->rays : seen->points;
    int64_t tiles = (LOCAL + (is_rays ? TILE : padded(seen->waves))) / TILE, width = TILE * tiles;
    int64_t place[tiles];
    bool used[tiles];
    for (int64_t segment = 0; segment < WIDTH_SEGMENTS; segment++) {
        for (int64_t t = 0; t < tiles; t++)
            place[t] = t < 3   ? 3 * (segment * BEND_SEGMENTS / WIDTH_SEGMENTS) + TILE * t
                       : t < 4 ? BENDS + segment
                               : (is_rays ? SHAPE : BODY) + TILE * (t - 4);
        for (int64_t t = 0; t < tiles; t++) used[t] = is_rays || t < LOCAL / TILE;
        int64_t filled = 0;
        for (int64_t i = 0; i < count; i++) {
            if (segment_of(read->index[i]) != segment) continue;
            double error = read->sd_m[i] * by, gap = read->gap_m[i] / error;
            double root = sqrt(share * (is_rays ? cauchy(gap) : tukey(gap)));
            if (root == 0) continue;
            double weight = root / error, *row = sums->rows + width * filled;
            slope(bases, read, i, segment, weight, row);
            double strength = weight * read->facing[i];
            if (is_rays) {
                row[LOCAL] = strength * read->away[3 * i], row[LOCAL + 1] = strength * read->away[3 * i + 1];
                row[LOCAL + 2] = -strength, row[LOCAL + 3] = 0;
            } else {
                for (int64_t t = LOCAL / TILE; t < tiles; t++) {
                    const double *waves_m = waves_of(seen, i) + TILE * t - LOCAL;
                    double sum = 0;
                    for (int k = 0; k < TILE; k++) {
                        row[TILE * t + k] = strength * waves_m[k];
                        sum += fabs(waves_m[k]);
                    }
                    used[t] |= sum > NEGLIGIBLE_M;
                }
            }
            for (int64_t t = 0; t < tiles; t++)
                for (int k = 0; k < TILE; k++) sums->target[place[t] + k] -= root * gap * row[TILE * t + k];
            if (++filled == ROWS) add_rows(sums->rows, filled, tiles, place, used, sums), filled = 0;
        }
        add_rows(sums->rows, filled, tiles, place, used, sums);
    }
}

void normal_equations(const struct bases *bases, const struct evidence *seen,
                      const struct readings *points, const struct readings *rays,
                      const double *scatters, double scale, struct equations *sums) {
    memset(sums->normal, 0, sizeof(double) * sums->stride * sums->stride);
    memset(sums->target, 0, sizeof(double) * sums->stride);
    double rough = larger(1, scatters[1]), rays_share = seen->rays_share / (rough * rough);
    add_kind(bases, seen, points, false, seen->points_share, scatters[0] * scale, sums);
    add_kind(bases, seen, rays, true, rays_share, scatters[1] * scale, sums);
}

/* Partly sort: nothing before number k is larger, nothing after it smaller (Hoare's FIND). */
static void partition(double *values, int64_t count, int64_t k) {
    for (int64_t first = 0, last = count - 1; first < last;) {
        double middle = values[k];
        int64_t i = first, j = last;
        while (i <= j) {
            while (i < last && values[i] < middle) i++;
            while (j > first && middle < values[j]) j--;
            if (i > j) break;
            double swapped = values[i];
            values[i++] = values[j], values[j--] = swapped;
        }
        if (j < k) first = i;
        if (k < i) last = j;
    }
}

double median_of(const double *values, int64_t count, double *scratch) {
    int64_t half = count / 2;
    if (values != scratch) memcpy(scratch, values, sizeof(double) * count);
    partition(scratch, count, half);
    if (count % 2) return scratch[half];
    double below = scratch[0];
    for (int64_t i = 1; i < half; i++) below = larger(below, scratch[i]);
    return (below + scratch[half]) / 2;
}

void ends_seen(const struct bases *bases, const struct shape *shape, int64_t count,
               const double *rays, const struct readings *read, int64_t *seen) {
    struct balls at;
    balls(bases, shape, &at);
    for (int end = 0; end < 2; end++) {
        int tip = end ? BALLS - 1 : 0, inner = end ? BALLS - 2 : 1, beyond = 0;
        double tangent[3] = {at.x[tip] - at.x[inner], at.y[tip] - at.y[inner], at.z[tip] - at.z[inner]};
        for (int64_t i = 0; i < count; i++) {
            if (!(fabs((double)read->index[i] / FINE - end) < 0.5 / BALLS)) continue;
            const double *ray = rays + 3 * i;
            double along = dot3(ray, tangent), ahead[3];
            for (int axis = 0; axis < 3; axis++) ahead[axis] = tangent[axis] - along * ray[axis];
            double norm = larger(sqrt(dot3(ahead, ahead)), 1e-12);
            beyond += -dot3(ahead, read->away + 3 * i) / norm > TIP_COSINE;
        }
        seen[end] = beyond >= TIP_RAYS;
    }
}
