"""Programs of C around an exported filter, with fields for what differs from filter to filter."""

MAIN = """/* Reads a table of measurements (CSV, a file or standard input) and writes the estimates.
   {begins} Where the first line is a hello of filtergym, such as
   `filtergym evaluate --policy exec:./run` writes it, the program speaks that protocol: a line of its own, and then
   frames of doubles, for any number of tracks. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"

#define COLUMNS {count} /* of the table */
#define INITIAL {initial}
#define MEASUREMENT {measurement}
#define ANSWER ({C} + {C} * {C})
#define FEEDBACK {feedback} /* numbers beside the estimate that steer the simulated world */
static const char columns[] =
    {columns};

static char line[1024 + 32 * (COLUMNS + INITIAL + MEASUREMENT) + sizeof columns];

/* The numbers of a line; an empty one is NaN. Returns how many there are. */
static int numbers(const char *text, double *row) {{
    int count = 0;
    for (;;) {{
        char *end;
        double value = strtod(text, &end);
        if (end == text) value = (double)NAN;
        if (count < COLUMNS) row[count] = value;
        ++count;
        while (*end != ',' && *end != '\\0' && *end != '\\n' && *end != '\\r') ++end;
        if (*end != ',') return count;
        text = end + 1;
    }}
}}

/* The number that follows a name in the hello; zero where there is none. */
static long number_of(const char *name) {{
    const char *place = strstr(line, name);
    return place == NULL ? 0 : strtol(place + strlen(name), NULL, 10);
}}

/* What was not received comes as NaN. In its place stands what the sensor said last, zero before: an agent may be
   shown the reading that a sensor holds, and a filter weighs the number by its availability. */
static void hold_missing(double *row, double *last) {{
    static const int available[] = {{{available}-1}};
    int i, missing = 0;
    for (i = 0; available[i] >= 0; ++i) missing |= !(row[available[i]] > 0.0);
    for (i = 0; i < MEASUREMENT; ++i)
        if (row[i] == row[i])
            last[i] = row[i];
        else if (missing)
            row[i] = last[i];
}}

/* Answers every measurement of some tracks until there are no more. */
static int serve(void) {{
    const long tracks = number_of("\\"tracks\\": ");
    const int steers = FEEDBACK > 0 && number_of("\\"feedback\\": ") == FEEDBACK;
    const int width = ANSWER + (steers ? FEEDBACK : 0);
    {own}_state *states;
    double *rows, *last;
    long t;
    int i, j;
    if (number_of("\\"filtergym\\": ") != 1 || number_of("\\"initial\\": ") != INITIAL ||
        number_of("\\"measurement\\": ") != MEASUREMENT || number_of("\\"answer\\": ") != ANSWER ||
        tracks < 1) {{
        puts("{{\\"error\\": \\"this filter was exported from another environment or scenario\\"}}");
        return 2;
    }}
    while (strchr(line, '\\n') == NULL && fgets(line, (int)sizeof line, stdin) != NULL) {{
    }}
    states = malloc((size_t)tracks * sizeof *states);
    rows = malloc((size_t)tracks * (INITIAL + MEASUREMENT + ANSWER + FEEDBACK) * sizeof *rows);
    last = calloc((size_t)tracks * MEASUREMENT, sizeof *last);
    if (states == NULL || rows == NULL || last == NULL) return 2;
    printf("{{\\"filtergym\\": 1, \\"format\\": \\"float64\\"%s}}\\n", steers ? ", \\"feedback\\": true" : "");
    fflush(stdout);
    if (fread(rows, INITIAL * sizeof *rows, (size_t)tracks, stdin) != (size_t)tracks) return 0;
    for (t = 0; t < tracks; ++t) {{
        {own}_initial initial;
        set_initial(&initial, rows + t * INITIAL);
        {own}_start(&states[t], &initial);
    }}
    while (fread(rows, MEASUREMENT * sizeof *rows, (size_t)tracks, stdin) == (size_t)tracks) {{
        double *answer = rows + tracks * MEASUREMENT;
        for (t = 0; t < tracks; ++t) {{
            {own}_measurement measurement;
            {own}_estimate estimate;
            hold_missing(rows + t * MEASUREMENT, last + t * MEASUREMENT);
            set_measurement(&measurement, rows + t * MEASUREMENT);
            if ({own}_update(&states[t], &measurement, &estimate) >= {upper}_REJECTED) {{
                for (i = 0; i < width; ++i) *answer++ = (double)NAN;
                continue;
            }}
            for (i = 0; i < {C}; ++i) *answer++ = (double)estimate.mean{mean};
            for (i = 0; i < {C}; ++i)
                for (j = 0; j < {C}; ++j) *answer++ = (double)estimate.covariance{entry};{steer}
        }}
        if (fwrite(answer - tracks * width, (size_t)width * sizeof *rows, (size_t)tracks, stdout) != (size_t)tracks)
            return 2;
        fflush(stdout);
    }}
    free(states);
    free(rows);
    free(last);
    return 0;
}}

{layout}
int main(int argc, char **argv) {{
    static {own}_state state;
    static double row[COLUMNS];
    long track = 0, measurement = 0, number = 1;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    if (file == NULL) {{
        fprintf(stderr, "cannot read %s\\n", argv[1]);
        return 2;
    }}
    line[0] = '\\0';
    if (fgets(line, (int)sizeof line, file) != NULL && file == stdin && line[0] == '{{') return serve();
    if (strncmp(line, columns, strlen(columns)) != 0 || strcspn(line, "\\r\\n") != strlen(columns)) {{
        fprintf(stderr, "the first line must be %s\\n", columns);
        return 2;
    }}
    puts({header});
    while (fgets(line, (int)sizeof line, file) != NULL) {{
        {own}_measurement measurement_now;
        {own}_estimate estimate;
        int i;
        ++number;
        if (line[strspn(line, "\\r\\n")] == '\\0') continue;
        if (numbers(line, row) != COLUMNS) {{
            fprintf(stderr, "line %ld must have %d numbers\\n", number, COLUMNS);
            return 2;
        }}
        if (begins(row)) {{
            {own}_initial initial;
            set_initial(&initial, initial_of(row));
            {own}_start(&state, &initial);
            ++track;
            measurement = 0;
        }}
        if (track == 0) {{
            fprintf(stderr, "line 2 must begin a track\\n");
            return 2;
        }}
        set_measurement(&measurement_now, measurement_of(row));
        {own}_update(&state, &measurement_now, &estimate);
        printf("%ld,%ld", track, ++measurement);{told}
        for (i = 0; i < {C}; ++i) printf(",%.{digits}g", (double)estimate.mean{mean});
        for (i = 0; i < {C}; ++i) printf(",%.{digits}g", sqrt((double)estimate.covariance{covariance}));
        putchar('\\n');
    }}
    if (file != stdin) fclose(file);
    return 0;
}}
"""
"""Reads a table of measurements and writes one of estimates."""
INITIAL_IN_ROW = """/* Whether a row begins a track, the initial estimate that it has, and its measurement. */
static int begins(const double *row) {{ return row[0] == row[0]; }}
static const double *initial_of(const double *row) {{ return row; }}
static const double *measurement_of(const double *row) {{ return row + INITIAL; }}
"""
"""Layout of the rows of a table with the initial estimate in the row that begins a track, and every number of a
measurement."""
INITIAL_OF_MODEL = """static const double initial_estimate[INITIAL] = {{{estimate}}};

/* Whether a row begins a track, the initial estimate of all tracks, and the measurement of a row. */
static int begins(const double *row) {{
    static double before;
    static int any = 0;
    const int begun = !any || row[0] != before;
    any = 1;
    before = row[0];
    return begun;
}}

static const double *initial_of(const double *row) {{
    (void)row;
    return initial_estimate;
}}

static const double *measurement_of(const double *row) {{
    static double given[MEASUREMENT];
    {fill}
    return given;
}}
"""
"""Layout of the rows of a table with the columns of a log, where the model has the initial estimate."""
POSITIONS = {
    ("latitude", "longitude", "altitude"): "if (!(fabs(a) <= 90.0 && fabs(b) <= 360.0)) return 0;\n"
    "    project(a, b, number(row, place[5]), p);",
    ("x", "y"): "p[0] = a;\n    p[1] = b;",
    ("range", "azimuth"): "p[0] = a * sin(b * DEGREE);\n    p[1] = a * cos(b * DEGREE);",
}
"""How a position p is made of the columns a and b of a log, the first pair that it has; a third one may lack."""
PROJECT = """
/* Latitude and longitude, degrees, around which positions are metres; the altitude of a row that has none, m. */
static const double origin[3] = {{{origin}}};

/* Earth-fixed coordinates, m, of angles in radians and a height above the ellipsoid WGS 84, m. */
static void earth_fixed(double latitude, double longitude, double height, double *r) {{
    const double flattening = 1.0 / 298.257223563, e2 = flattening * (2.0 - flattening);
    const double n = 6378137.0 / sqrt(1.0 - e2 * (sin(latitude) * sin(latitude)));
    const double across = (n + height) * cos(latitude);
    r[0] = across * cos(longitude);
    r[1] = across * sin(longitude);
    r[2] = (n * (1.0 - e2) + height) * sin(latitude);
}}

/* Coordinates east and north of the origin, m, in the plane that touches the ellipsoid there. */
static void project(double latitude, double longitude, double height, double *p) {{
    const double b = origin[0] * DEGREE, l = origin[1] * DEGREE;
    double r[3], r0[3];
    int i;
    earth_fixed(b, l, 0.0, r0);
    earth_fixed(latitude * DEGREE, longitude * DEGREE, height - height == 0.0 ? height : origin[2], r);
    for (i = 0; i < 3; ++i) r[i] -= r0[i];
    p[0] = cos(l) * r[1] - sin(l) * r[0];
    p[1] = cos(b) * r[2] - sin(b) * (cos(l) * r[0] + sin(l) * r[1]);
}}
"""
"""Makes metres of latitude and longitude."""
LOG = """/* Reads a log (CSV, a file or standard input) as it was read when this filter was advised, and writes an
   estimate for each row: the track starts from the first two plots, and scans without a row have missed the target. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "{own}.h"

#define INTERVAL {interval} /* s */
#define DEGREE (3.14159265358979323846 / 180.0)

/* Time, two coordinates, and their deviations, which a log may lack; so it may the altitude, where that is read. */
static const char *const names[{count}] = {{{columns}}};
static const double usual[2] = {{{first}, {second}}};
static int place[6] = {{-1, -1, -1, -1, -1, -1}};
static char line[65536];

static {own}_state state;
static double p0[2], v0[2], last, last_plot, scan;

/* Number in a column of a row; NaN where there is none. */
static double number(const char *row, int column) {{
    char *end;
    double value;
    if (column < 0) return (double)NAN;
    for (; column > 0; --column) {{
        row = strchr(row, ',');
        if (row == NULL) return (double)NAN;
        ++row;
    }}
    value = strtod(row, &end);
    return end == row ? (double)NAN : value;
}}

/* Finds the columns in the first line; names are read without regard to case. */
static void find_columns(char *row) {{
    int column = 0;
    char *word = row;
    for (;; ++column) {{
        size_t length = strcspn(word, ",\\r\\n"), i;
        const char after = word[length];
        int k;
        word[length] = '\\0';
        for (i = 0; i < length; ++i)
            if (word[i] >= 'A' && word[i] <= 'Z') word[i] = (char)(word[i] - 'A' + 'a');
        for (k = 0; k < {count}; ++k)
            if (strcmp(word, names[k]) == 0) place[k] = column;
        if (after != ',') return;
        word += length + 1;
    }}
}}
{project}
/* Position and variances of a row, in metres east and north; returns whether there is a plot. */
static int read_plot(const char *row, double *p, double *v) {{
    const double a = number(row, place[1]), b = number(row, place[2]);
    double s = number(row, place[3]), r = number(row, place[4]);
    if (!(a - a == 0.0 && b - b == 0.0)) return 0;
    if (!(s > 0.0)) s = usual[0];
    if (!(r > 0.0)) r = usual[1];
    {position}
    v[0] = s * s;
    v[1] = r * r;
    if ({stated_polar}) {{
        /* Range and azimuth, rotated into east and north; the diagonal of the covariance. */
        const double square = p[0] * p[0] + p[1] * p[1];
        const double along = square > 0.0 ? p[0] * p[0] / square : 0.5;
        const double across = square * (r * DEGREE) * (r * DEGREE);
        v[0] = along * s * s + (1.0 - along) * across;
        v[1] = (1.0 - along) * s * s + along * across;
    }}
    return 1;
}}

static int step(double at, double available, const double *p, const double *v, {own}_estimate *estimate) {{
    {own}_measurement m;
    const double interval = at - last, elapsed = at - last_plot;
    int status;
    scan += 1.0;
    (void)interval;
    (void)elapsed;
    (void)available;
    (void)p;
    (void)v;
    {fill}
    status = {own}_update(&state, &m, estimate);
    if (status == {upper}_REFUSED) return status;
    last = at;
    if (available > 0.0) last_plot = at;
    return status;
}}

int main(int argc, char **argv) {{
    static const char *const words[4] = {{"taken", "missed", "rejected", "refused"}};
    static const double none[2] = {{0.0, 0.0}}, one[2] = {{1.0, 1.0}};
    long plots = 0;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    if (file == NULL) {{
        fprintf(stderr, "cannot read %s\\n", argv[1]);
        return 2;
    }}
    if (fgets(line, (int)sizeof line, file) != NULL) find_columns(line);
    if (place[0] < 0 || place[1] < 0 || place[2] < 0) {{
        fprintf(stderr, "the first line must name %s, %s and %s, separated by commas\\n", names[0], names[1], names[2]);
        return 2;
    }}
    puts({header});
    while (fgets(line, (int)sizeof line, file) != NULL) {{
        double p[2] = {{0.0, 0.0}}, v[2] = {{1.0, 1.0}};
        const double at = number(line, place[0]);
        const int there = read_plot(line, p, v);
        {own}_estimate estimate;
        double scans, k;
        int i, status;
        if (!(at - at == 0.0)) continue;
        if (plots < 2) {{
            if (!there) continue;
            if (plots == 1) {{
                const double lasted = at - last;
                {own}_initial initial;
                if (!(lasted > 0.0)) continue;
                {start}
                {own}_start(&state, &initial);
            }}
            ++plots;
            memcpy(p0, p, sizeof p0);
            memcpy(v0, v, sizeof v0);
            last = last_plot = at;
            continue;
        }}
        scans = floor((at - last) / INTERVAL + 0.5);
        if (scans > 1.0 && scans <= 1001.0) {{
            const double begun = last;
            for (k = 1.0; k < scans; k += 1.0) (void)step(begun + (at - begun) * k / scans, 0.0, none, one, &estimate);
        }}
        status = step(at, there ? 1.0 : 0.0, p, v, &estimate);
        printf("%.17g,%s", at, words[status]);
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", (double)estimate.mean[i]);
            else
                printf(",");
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", sqrt((double)estimate.covariance[i][i]));
            else
                printf(",");
        putchar('\\n');
    }}
    if (file != stdin) fclose(file);
    return 0;
}}
"""
"""Reads a log as it was read when the filter was advised, and writes an estimate for each row."""
PLAIN_LOG = """/* Reads a log (CSV, a file or standard input) as `filtergym evaluate --recording` reads it, and
   writes an estimate for each row. The track starts with the initial estimate of the model one interval before the
   first row. An empty cell was not received; of an input the last number holds on. Rows of one time are joined. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"

#define INTERVAL {interval} /* s; zero: rows come at any time */
#define FIRST {first} /* interval before the first row, s; zero: the median of all, or INTERVAL */
#define RECEIVED {received}
#define COLUMNS {count} /* what is received, and then the inputs */
#define LONGEST 1048576

static const char *const times[] = {{{times}}};
static const char *const names[COLUMNS] = {{{names}}};
static const double initial_estimate[] = {{{estimate}}};
static int place[COLUMNS], time_place = -1;
static char line[LONGEST], delimiter = ',';

static int fail(const char *words, const char *name, long number) {{
    fprintf(stderr, "%s %s (line %ld)\\n", words, name, number);
    return 2;
}}

/* Where a column of a row begins; NULL where it has no such column. */
static const char *begin_of(const char *row, int column) {{
    for (; column > 0 && row != NULL; --column) {{
        row = strchr(row, delimiter);
        if (row != NULL) ++row;
    }}
    return row;
}}

/* Copies a cell of a row without spaces and quotes, with a point for a decimal comma; returns whether it is filled. */
static int cell(const char *row, int column, char *text, size_t size) {{
    size_t length = 0;
    row = begin_of(row, column);
    if (row == NULL) return 0;
    for (; *row != delimiter && *row != '\\0' && *row != '\\n' && *row != '\\r' && length + 1 < size; ++row)
        if (*row != ' ' && *row != '"') text[length++] = *row == ',' ? '.' : *row;
    text[length] = '\\0';
    return length > 0;
}}

/* Number in a cell, NaN in an empty one; returns whether it is either. */
static int number(const char *row, int column, double *value) {{
    char text[400], *end;
    *value = (double)NAN;
    if (!cell(row, column, text, sizeof text)) return 1;
    *value = strtod(text, &end);
    return *end == '\\0';
}}

/* Finds the columns in the first line; names are read without regard to case. */
static int find_columns(char *row) {{
    char text[400];
    int column, k;
    size_t i;
    if (strncmp(row, "\\xEF\\xBB\\xBF", 3) == 0) memset(row, ' ', 3);
    if (strchr(row, ',') == NULL) delimiter = strchr(row, ';') != NULL ? ';' : '\\t';
    for (k = 0; k < COLUMNS; ++k) place[k] = -1;
    for (column = 0; begin_of(row, column) != NULL; ++column) {{
        if (!cell(row, column, text, sizeof text)) continue;
        for (i = 0; text[i] != '\\0'; ++i)
            if (text[i] >= 'A' && text[i] <= 'Z') text[i] = (char)(text[i] - 'A' + 'a');
        if (strcmp(text, "recording") == 0) return fail("several tracks are not read: leave out the column", text, 1);
        for (i = 0; i < sizeof times / sizeof *times; ++i)
            if (strcmp(text, times[i]) == 0 && time_place < 0) time_place = column;
        for (k = 0; k < COLUMNS; ++k)
            if (strcmp(text, names[k]) == 0) place[k] = column;
    }}
    if (time_place < 0) return fail("it lacks the column", times[0], 1);
    for (k = 0; k < COLUMNS; ++k)
        if (place[k] < 0) return fail("it lacks the column", names[k], 1);
    return 0;
}}

static int ascending(const void *a, const void *b) {{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}}

/* Median of the intervals between rows, to six digits. */
static double usual_interval(const double *at, long count) {{
    double *steps = malloc((size_t)count * sizeof *steps), median;
    char text[40];
    long k;
    if (steps == NULL) return (double)NAN;
    for (k = 1; k < count; ++k) steps[k - 1] = at[k] - at[k - 1];
    qsort(steps, (size_t)(count - 1), sizeof *steps, ascending);
    median = 0.5 * (steps[(count - 1) / 2] + steps[(count - 2) / 2]);
    free(steps);
    sprintf(text, "%.6g", median);
    return strtod(text, NULL);
}}

static {own}_state state;

static int step(double interval, const double *row, const double *held, {own}_estimate *estimate) {{
    {own}_measurement m;
    double given[{measurement}];
    (void)interval;
    (void)held;
    {fill}
    set_measurement(&m, given);
    return {own}_update(&state, &m, estimate);
}}

int main(int argc, char **argv) {{
    static const char *const words[4] = {{"taken", "missed", "rejected", "refused"}};
    static double held[COLUMNS + 1], nothing[COLUMNS], joined[COLUMNS];
    double *rows = NULL, *at = NULL, *written = NULL, first_time = 0.0, unit = 1.0, before;
    long count = 0, room = 0, line_number = 1, k;
    int i, differ = 0, wrong;
    {own}_initial initial;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    if (file == NULL) return fail("cannot read", argv[1], 0);
    if (fgets(line, LONGEST, file) == NULL) return fail("it is", "empty", 1);
    if ((wrong = find_columns(line)) != 0) return wrong;
    while (fgets(line, LONGEST, file) != NULL) {{
        double as_written, now;
        ++line_number;
        if (line[strspn(line, "\\r\\n")] == '\\0') continue;
        if (!number(line, time_place, &as_written) || !(as_written - as_written == 0.0))
            return fail("a number of seconds must be in the column", times[0], line_number);
        if (count == 0)
            for (first_time = as_written; unit < 1e9 && first_time > 1e11 * unit;) unit *= 1e3;
        now = unit > 1.0 ? (as_written - first_time) / unit : as_written;
        if (count > 0 && now < at[count - 1]) return fail("rows must be sorted by", times[0], line_number);
        if (count == room) {{
            room = 2 * room + 1024;
            rows = realloc(rows, (size_t)room * COLUMNS * sizeof *rows);
            at = realloc(at, (size_t)room * sizeof *at);
            written = realloc(written, (size_t)room * sizeof *written);
            if (rows == NULL || at == NULL || written == NULL) return fail("no memory for", "the rows", line_number);
        }}
        for (i = 0; i < COLUMNS; ++i)
            if (!number(line, place[i], rows + count * COLUMNS + i) || isinf(rows[count * COLUMNS + i]))
                return fail("a finite number must be in the column", names[i], line_number);
        if (count > 0 && now == at[count - 1]) {{
            for (i = 0; i < COLUMNS; ++i) {{
                const double value = rows[count * COLUMNS + i];
                if (value == value && joined[i] == joined[i]) differ |= value != joined[i];
                if (value == value && !(joined[i] == joined[i])) joined[i] = value;
            }}
            continue;
        }}
        /* Rows of one time supply each other; where two of them differ in a number, the first alone counts. */
        if (count > 0 && !differ) memcpy(rows + (count - 1) * COLUMNS, joined, sizeof joined);
        memcpy(joined, rows + count * COLUMNS, sizeof joined);
        differ = 0;
        at[count] = now;
        written[count++] = as_written;
    }}
    if (count < 2) return fail("there must be several", "rows", line_number);
    if (!differ) memcpy(rows + (count - 1) * COLUMNS, joined, sizeof joined);
    for (i = 0; i < COLUMNS; ++i) nothing[i] = (double)NAN;
    for (i = RECEIVED; i < COLUMNS; ++i) {{
        for (k = 0; k < count && !(rows[k * COLUMNS + i] == rows[k * COLUMNS + i]); ++k) continue;
        if (k == count) return fail("no row has a number of", names[i], line_number);
        held[i - RECEIVED] = rows[k * COLUMNS + i];
    }}
    set_initial(&initial, initial_estimate);
    {own}_start(&state, &initial);
    before = at[0] - (FIRST > 0.0 ? FIRST : INTERVAL > 0.0 ? INTERVAL : usual_interval(at, count));
    puts({header});
    for (k = 0; k < count; ++k) {{
        const double *row = rows + k * COLUMNS;
        {own}_estimate estimate;
        double interval = at[k] - before;
        int status;
        if (INTERVAL > 0.0 && k > 0) {{
            const double steps = floor(interval / INTERVAL + 0.5);
            double missed;
            if (!(fabs(interval - steps * INTERVAL) <= 0.01 * INTERVAL) || steps > 1000.0)
                return fail("rows must be whole intervals apart, by", times[0], k + 2);
            for (missed = 1.0; missed < steps; missed += 1.0) (void)step(INTERVAL, nothing, held, &estimate);
        }}
        for (i = RECEIVED; i < COLUMNS; ++i)
            if (row[i] == row[i]) held[i - RECEIVED] = row[i];
        status = step(interval, row, held, &estimate);
        before = at[k];
        printf("%.17g,%s", written[k], words[status]);
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", (double)estimate.mean{mean});
            else
                printf(",");
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", sqrt((double)estimate.covariance{covariance}));
            else
                printf(",");
        putchar('\\n');
    }}
    if (file != stdin) fclose(file);
    return 0;
}}
"""
"""Reads a log whose rows are measurements as they stand, and writes an estimate for each row."""
TEST = """/* Compares the filter with what the competitor itself estimated, and says how long an update takes. */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "rows.h"
#include "vectors.h"

#define LIMIT {limit} /* standard deviations */

static double run(double worst) {{
    int track, k, i;
    for (track = 0; track < TRACKS; ++track) {{
        {own}_state state;
        {own}_initial initial;
        set_initial(&initial, initials[track]);
        {own}_start(&state, &initial);
        for (k = track * MEASUREMENTS; k < (track + 1) * MEASUREMENTS; ++k) {{
            {own}_measurement measurement;
            {own}_estimate estimate;
            set_measurement(&measurement, measurements[k]);
            {own}_update(&state, &measurement, &estimate);
            for (i = 0; i < {C}; ++i) {{
                const double off = fabs((double)estimate.mean{mean} - means[k][i]);
                const double difference = off == 0.0 ? 0.0 : off / sigmas[k][i];
                if (!(difference <= worst)) worst = difference;
            }}
        }}
    }}
    return worst;
}}

int main(void) {{
    const double worst = run(0.0);
    const clock_t begin = clock();
    long updates = 0;
    double seconds;
    volatile double kept;
    do {{
        kept = run(0.0);
        updates += TRACKS * MEASUREMENTS;
        seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
    }} while (seconds < 0.2);
    (void)kept;
    printf("largest difference %.1e standard deviations, %.0f ns an update\\n", worst, 1e9 * seconds / (double)updates);
    return worst <= LIMIT ? 0 : 1;
}}
"""
"""Compares the filter with the vectors, and measures its time."""
