"""Programs of C that read a log as filtergym reads it, with fields for the parts that differ from filter to filter.

A program is :data:`LOG`, :data:`READER` and a function ``follow``. The reader takes the whole file into rows, sorts
them into tracks, leaves out duplicates, and calls ``follow`` for each track, which is :data:`PLOTS`,
:data:`PLAIN_ROWS` or :data:`REGULAR_ROWS`. Their numbers and names are from :mod:`.c_log`.
"""

from pathlib import Path

LOG = """/* Reads a log (CSV, a file or standard input) as `filtergym evaluate --recording` reads it, and
   writes an estimate for each row:
   {about}
   Commas, semicolons or tabs, decimal commas, quotes, times as numbers, dates or times of day, and several
   recordings in one file are recognised. A cell that cannot be read ends the program with status 2, before anything is
   written. A row with the time of the row before leaves the state as it was: `joined` where it supplied what that
   one lacked, else `repeated`. Rejected and refused rows have no estimate, and the program then ends with status 1. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"

/* --- The reading, as filtergym declares it. */

{reading}
#define COLUMNS {count}
#define NEEDED {needed} /* The first ones; others may be missing. */

/* Names of the columns, in lower case: of the times, of which the first counts, and of numbers. */
static const char *const times[] = {{{times}}};
static const char *const names[COLUMNS] = {{{names}}};
static const char recordings[] = {recording};
static const char delimiters[] = {delimiters};
static const double units[] = {{{units}}}; /* Possible units of numbers since 1970, s. */

/* --- The filter. */

typedef {own}_state State;
typedef {own}_estimate Estimate;
#define COMPONENTS {C}
#define MEAN(estimate, i) (estimate)->mean{mean}
#define VARIANCE(estimate, i) (estimate)->covariance{covariance}
#define DIGITS {digits}
static const char header[] =
    {header};

/* --- The file. */

"""
"""Begins the program that reads a log: all that differs from filter to filter before :data:`READER`."""
READER = Path(__file__).with_name("log_reader.c").read_text(encoding="ascii")
"""Reads a log, finds its tracks, and writes an estimate for each row; the same for every filter."""
ODOMETRY = {
    ("odometry_x", "odometry_y"): """row->moved[0] = a;
        row->moved[1] = b;""",
    ("odometry_speed", "odometry_heading"): """if (i > 0) {
            const double *last_cell = own[i - 1]->cell, half = 0.5 * (row->time - own[i - 1]->time);
            const double c = last_cell[FIRST_ODOMETRY], d = last_cell[FIRST_ODOMETRY + 1];
            row->moved[0] = half * (c * sin(d * DEGREE) + a * sin(b * DEGREE));
            row->moved[1] = half * (c * cos(d * DEGREE) + a * cos(b * DEGREE));
        }""",
}
"""Displacement from the columns a and b of a second sensor, the first pair that a log has."""
READ_ODOMETRY = """
/* Computes displacements of the rows of a track; rows without a number have none. */
static int read_odometry(long n) {{
    long i;
    int k;
    for (k = FIRST_ODOMETRY; k < FIRST_ODOMETRY + 2; ++k)
        if (column[k] < 0) return fail("it lacks the column", names[k], NULL);
    for (i = 0; i < n; ++i) {{
        Row *row = own[i];
        const double a = row->cell[FIRST_ODOMETRY], b = row->cell[FIRST_ODOMETRY + 1];
        row->moved[0] = row->moved[1] = (double)NAN;
        {displacement}
        row->odometry = row->moved[0] == row->moved[0] && row->moved[1] == row->moved[1];
    }}
    return 0;
}}
"""
"""Reads a second sensor."""
POSITIONS: dict[tuple[str, ...], str] = {
    ("latitude", "longitude", "altitude"): """if (!(fabs(a) <= 90.0 && fabs(b) <= 360.0))
            return fail("degrees are expected of latitude and longitude,", "not these", row);
        project(a, b, column[4] < 0 ? (double)NAN : row->cell[4], row->p);
        row->m[0] = 111e3 * cos(origin[0] * DEGREE) * b;
        row->m[1] = 111e3 * a;""",
    ("x", "y"): """row->p[0] = row->m[0] = a;
        row->p[1] = row->m[1] = b;""",
    ("range", "azimuth"): """if (!(a >= 0.0 && fabs(b) <= 360.0))
            return fail("a distance and degrees are expected of range and azimuth,", "not these", row);
        row->p[0] = row->m[0] = a * sin(b * DEGREE);
        row->p[1] = row->m[1] = a * cos(b * DEGREE);""",
}
"""Position from the columns a and b of a log, the first pair that it has; a third one may be missing."""
PROJECT = """
/* Latitude and longitude, degrees, around which positions are metres; the altitude of a row that has none, m. */
static double origin[3];

/* Finds them: the first position of a track, and the median of its altitudes. */
static int find_origin(long n) {
    long i, heights = 0, found = -1;
    for (i = n - 1; i >= 0; --i) {
        const double *cell = own[i]->cell;
        if (cell[0] == cell[0] && cell[1] == cell[1] && !(cell[0] == 0.0 && cell[1] == 0.0)) found = i;
        if (cell[4] == cell[4]) sorted[heights++] = cell[4];
    }
    if (found < 0) return fail("no row has a position of", names[0], NULL);
    origin[0] = own[found]->cell[0];
    origin[1] = own[found]->cell[1];
    origin[2] = heights > 0 ? median(heights) : 0.0;
    fprintf(stderr, "x is east and y north of latitude %.8f, longitude %.8f\\n", origin[0], origin[1]);
    return 0;
}

/* Earth-fixed coordinates, m, of angles in radians and a height above the ellipsoid WGS 84, m. */
static void earth_fixed(double latitude, double longitude, double height, double *r) {
    const double flattening = 1.0 / 298.257223563, e2 = flattening * (2.0 - flattening);
    const double n = 6378137.0 / sqrt(1.0 - e2 * (sin(latitude) * sin(latitude)));
    const double across = (n + height) * cos(latitude);
    r[0] = across * cos(longitude);
    r[1] = across * sin(longitude);
    r[2] = (n * (1.0 - e2) + height) * sin(latitude);
}

/* Coordinates east and north of the origin, m, in the plane that touches the ellipsoid there. */
static void project(double latitude, double longitude, double height, double *p) {
    const double b = origin[0] * DEGREE, l = origin[1] * DEGREE;
    double r[3], r0[3];
    int i;
    earth_fixed(b, l, 0.0, r0);
    earth_fixed(latitude * DEGREE, longitude * DEGREE, height == height ? height : origin[2], r);
    for (i = 0; i < 3; ++i) r[i] -= r0[i];
    p[0] = cos(l) * r[1] - sin(l) * r[0];
    p[1] = cos(b) * r[2] - sin(b) * (cos(l) * r[0] + sin(l) * r[1]);
}
"""
"""Makes metres of latitude and longitude."""
PLOTS = """#define INTERVAL {interval} /* s */
#define DEGREE (3.14159265358979323846 / 180.0)

static const double usual[2] = {{{first}, {second}}}; /* deviations of a log that states none */
static double p0[2], v0[2], last, last_plot, scan;
{project}
/* Empties repeated positions, where noise would hardly ever repeat both numbers. */
static void leave_out_stale(long n) {{
    const double *before = NULL;
    double gap;
    int axis, fine = 1;
    long i, plots;
    for (axis = 0; axis < 2; ++axis) {{
        double finest = HUGE_VAL;
        for (i = 0, plots = 0; i < n; ++i)
            if (own[i]->plot) sorted[plots++] = own[i]->m[axis];
        if (plots == 0) return;
        qsort(sorted, (size_t)plots, sizeof *sorted, ascending);
        for (i = 1; i < plots; ++i)
            if ((gap = sorted[i] - sorted[i - 1]) > 0.0 && gap < finest) finest = gap;
        for (i = 0, plots = 0; i < n; ++i)
            if (own[i]->plot) sorted[plots++] = sqrt(own[i]->v[axis]);
        fine &= median(plots) >= FINER * finest;
    }}
    for (i = 0; i < n && fine; ++i)
        if (own[i]->plot) {{
            own[i]->plot = before == NULL || before[0] != own[i]->m[0] || before[1] != own[i]->m[1];
            before = own[i]->m;
        }}
}}

{odometry}
/* Makes positions and variances of the rows of a track. */
static int read_plots(long n) {{
    long i, plots = 0;
    int deviation;
    if ((column[2] < 0) != (column[3] < 0)) return fail("it lacks the column", names[column[2] < 0 ? 2 : 3], NULL);
    {locate}for (i = 0; i < n; ++i) {{
        Row *row = own[i];
        const double a = row->cell[0], b = row->cell[1];
        double s = usual[0], r = usual[1];
        row->plot = a == a && b == b{fix};
        if ({both} && (a == a) != (b == b)) return fail("there is one coordinate of two", "alone", row);
        if (!row->plot) continue;
        for (deviation = 2; deviation < 4 && column[2] >= 0; ++deviation)
            if (!(row->cell[deviation] > 0.0))
                return fail("above zero must be the standard deviation", names[deviation], row);
        if (column[2] >= 0) {{
            s = row->cell[2];
            r = row->cell[3];
        }}
        {position}
        if (hypot(row->p[0], row->p[1]) > FARTHEST) return fail("too far away, in metres, is the", "position", row);
        row->v[0] = s * s;
        row->v[1] = r * r;
        if ({stated_polar}) {{
            /* Range and azimuth, rotated into east and north; the diagonal of the covariance. */
            const double square = row->p[0] * row->p[0] + row->p[1] * row->p[1];
            const double along = square > 0.0 ? row->p[0] * row->p[0] / square : 0.5;
            const double across = square * (r * DEGREE) * (r * DEGREE);
            row->v[0] = along * s * s + (1.0 - along) * across;
            row->v[1] = (1.0 - along) * s * s + along * across;
        }}
    }}
    leave_out_stale(n);
    {read_odometry}for (i = 0; i < n; ++i) plots += own[i]->plot;
    return plots < 3 ? fail("a track starts from two plots and goes on: there are no three", "of them", own[0]) : 0;
}}

/* Updates with a scan: the last one of several until a row, or an earlier one that misses the target. */
static int step(double at, const Row *row, double scans, int is_last, Estimate *estimate) {{
    static const double none[2] = {{0.0, 0.0}}, nominal[2] = {{{nominal}, {nominal}}};
    const double interval = at - last, elapsed = at - last_plot, available = is_last && row->plot ? 1.0 : 0.0;
    const double *p = available > 0.0 ? row->p : none, *v = available > 0.0 ? row->v : nominal;
    {own}_measurement m;
    double given[{measurement}];
    int status;
    (void)interval;
    (void)elapsed;
    (void)p;
    (void)v;
    (void)scans;
    {fill}
    set_measurement(&m, given);
    status = {own}_update(&state, &m, estimate);
    if (status > MISSED) return status;
    scan += 1.0;
    last = at;
    if (available > 0.0) last_plot = at;
    return status;
}}

/* Follows a track, which starts from its first two plots; scans without a row have missed the target. */
static int follow(long n) {{
    long i;
    int plots = 0, wrong = read_plots(n);
    scan = 0.0;
    for (i = 0; i < n && wrong == 0; ++i) {{
        const Row *row = own[i];
        Estimate estimate;
        double scans, begun, k;
        if (plots < 2) {{
            const double *p = row->p, *v = row->v;
            if (!row->plot) continue;
            if (++plots == 2) {{
                const double lasted = row->time - last;
                double given[{initial}];
                {own}_initial initial;
                {start}
                set_initial(&initial, given);
                {own}_start(&state, &initial, NULL);
            }}
            memcpy(p0, p, sizeof p0);
            memcpy(v0, v, sizeof v0);
            last = last_plot = row->time;
            continue;
        }}
        scans = fmax(rint((row->time - last) / INTERVAL), 1.0);
        if (scans > MOST_MISSED + 1.0) return fail("too many intervals without a row end", "here: cut it", row);
        begun = last;
        for (k = 1.0; k < scans; k += 1.0)
            (void)note(row, step(begun + (row->time - begun) * k / scans, row, scans, 0, &estimate));
        print_row(row, note(row, step(row->time, row, scans, 1, &estimate)), &estimate);
    }}
    return wrong;
}}
"""
"""Follows tracks of plots."""
PLAIN_ROWS = """#define INTERVAL {interval} /* s; zero: rows come at any time */
#define FIRST {first} /* interval before the first row, s; zero: the median of all, or INTERVAL */

static const double initial_estimate[] = {{{estimate}}};

/* Median of the intervals between rows, to six digits. */
static double usual_interval(long n) {{
    char digits[40];
    long k;
    for (k = 1; k < n; ++k) sorted[k - 1] = own[k]->time - own[k - 1]->time;
    sprintf(digits, "%.6g", median(n - 1));
    return strtod(digits, NULL);
}}

static int step(double interval, const double *row, const double *held, Estimate *estimate) {{
    {own}_measurement m;
    double given[{measurement}];
    (void)interval;
    (void)held;
    {fill}
    set_measurement(&m, given);
    return {own}_update(&state, &m, estimate);
}}

/* Follows a track, which starts with the estimate of the model one interval before the first row. */
static int follow(long n) {{
    double held[COLUMNS + 1], nothing[COLUMNS], before;
    {own}_initial initial;
    long i, k;
    int c;
    for (c = 0; c < COLUMNS; ++c) nothing[c] = (double)NAN;
    for (c = RECEIVED; c < COLUMNS; ++c) {{
        for (k = 0; k < n && own[k]->cell[c] != own[k]->cell[c]; ++k) continue;
        if (k == n) return fail("no row has a number of", names[c], NULL);
        held[c - RECEIVED] = own[k]->cell[c];
    }}
    set_initial(&initial, initial_estimate);
    {own}_start(&state, &initial, NULL);
    before = own[0]->time - (FIRST > 0.0 ? FIRST : INTERVAL > 0.0 ? INTERVAL : usual_interval(n));
    for (i = 0; i < n; ++i) {{
        const Row *row = own[i];
        Estimate estimate;
        double interval = row->time - before;
        int status;
        if (INTERVAL > 0.0 && i > 0) {{
            const double steps = rint(interval / INTERVAL);
            double missed;
            if (!(fabs(interval - steps * INTERVAL) <= UNEVEN * INTERVAL) || steps < 1.0 || steps > MOST_MISSED)
                return fail("rows must be whole intervals apart, by their time", "it is not", row);
            for (missed = 1.0; missed < steps; missed += 1.0)
                if (note(row, step(INTERVAL, nothing, held, &estimate)) <= MISSED) before += INTERVAL;
            interval = INTERVAL;
        }}
        for (c = RECEIVED; c < COLUMNS; ++c)
            if (row->cell[c] == row->cell[c]) held[c - RECEIVED] = row->cell[c];
        status = note(row, step(interval, row->cell, held, &estimate));
        if (status <= MISSED) before = row->time;
        print_row(row, status, &estimate);
    }}
    return 0;
}}
"""
"""Follows tracks of rows that are measurements as they stand."""
REGULAR_ROWS = """#define INTERVAL {interval} /* s */

{reading}

/* Follows a track: its first row is the start, each further one a measurement. */
static int follow(long n) {{
    double given[{most}], found[FOUND];
    long i, received = 0;
    int k, wrong = 0;
    for (i = 0; i < n && wrong == 0; ++i) {{
        const Row *row = own[i];
        for (k = 0; k < WHOLE && wrong == 0; ++k)
            if (row->cell[k] != row->cell[k]) wrong = fail(names[k], "has no value", row);
        if (wrong == 0 && i > 0 && !(fabs(row->time - own[i - 1]->time - INTERVAL) <= UNEVEN * INTERVAL))
            wrong = fail("rows must be one interval apart, by their time:", "it is not", row);
        if (wrong == 0) wrong = read_values(row, i, found);
        received += wrong == 0 && i > 0 && found[0] > 0.0;
    }}
    if (wrong == 0 && received == 0) wrong = fail("no row has on every axis a", names[NEEDED - 1], NULL);
    for (i = 0; i < n && wrong == 0; ++i) {{
        const Row *row = own[i];
        const double *cell = row->cell, *before = own[i > 0 ? i - 1 : 0]->cell;
        {own}_initial initial;
        {own}_measurement m;
        Estimate estimate;
        (void)before;
        wrong = read_values(row, i, found);
        if (i == 0) {{
            {start}
            set_initial(&initial, given);
            {own}_start(&state, &initial, NULL);
            continue;
        }}
        {fill}
        set_measurement(&m, given);
        print_row(row, note(row, {own}_update(&state, &m, &estimate)), &estimate);
    }}
    return wrong;
}}
"""
"""Follows tracks of rows at one rate, the first of which starts the track."""
READ_FIXES = """#define FOUND 1

/* Finds whether a row has a fix. */
static int read_values(const Row *row, long i, double *found) {{
    int k;
    (void)i;{check}
    found[0] = 1.0;
    for (k = NEEDED - {axes}; k < NEEDED; ++k)
        if (row->cell[k] != row->cell[k]) found[0] = 0.0;
    return 0;
}}"""
"""Reads rows with positions by an INS and by a receiver; the last required columns are the receiver's."""
CHECK_SIGMA = """
    if (!(row->cell[{sigma}] > 0.0)) return fail("above zero must be the standard deviation", names[{sigma}], row);"""
"""Checks the standard deviation that the receiver states."""
READ_LOOKS = """#define FOUND 4

/* Finds whether the ESM listened, what it decided for, and the difference of the bearings in degrees. */
static int read_values(const Row *row, long i, double *found) {{
    const double decision = {decision}, looked = {looked}, stated = {bearing_difference};
    const double apart = stated == stated ? stated : {radar_bearing} - {esm_bearing};
    const int decided = decision == decision;
    if (i > HORIZON) return fail("the filter is made for shorter tracks: advise on this log, which", "goes on", row);
    if (decided && !(decision == floor(decision) && decision >= 0.0 && decision < TYPES))
        return fail("the number of an emitter type is not", "the decision", row);
    if (decided && apart != apart) return fail("no bearings are beside", "the decision", row);
    found[0] = 1.0;
    found[1] = decided || (looked == looked ? looked > 0.5 : i % ESM_PERIOD == 0) ? 1.0 : 0.0;
    found[2] = decided ? decision : TYPES;
    found[3] = decided ? apart - 360.0 * floor((apart + 180.0) / 360.0) : 0.0;
    return 0;
}}"""
"""Reads rows of a radar with the reports of an ESM."""
