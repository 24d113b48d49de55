"""Programs of C around an exported filter, with fields for the parts that differ from filter to filter."""

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

/* The numbers of a line; an empty one is NaN. Returns their count, or minus the place of an invalid one. */
static int numbers(const char *text, double *row) {{
    int count = 0;
    for (;;) {{
        char *end;
        double value = strtod(text, &end);
        if (end == text) value = (double)NAN;
        end += strspn(end, " \\t");
        if (strchr(",\\r\\n", *end) == NULL) return -1 - count;
        if (count < COLUMNS) row[count] = value;
        ++count;
        if (*end != ',') return count;
        text = end + 1;
    }}
}}

/* The number that follows a name in the hello; zero where there is none. */
static long number_of(const char *name) {{
    const char *place = strstr(line, name);
    return place == NULL ? 0 : strtol(place + strlen(name), NULL, 10);
}}

/* A missing number is NaN. It is replaced by the sensor's last reading, before that by zero: an agent may observe the
   last reading, and a filter weighs the number by its availability. */
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

/* Writes the estimate of every measurement of some tracks until the end of input. */
static int answer_all(long tracks, int steers, {own}_state *states, double *rows, double *last) {{
    const int width = ANSWER + (steers ? FEEDBACK : 0);
    long t;
    int i, j;
    printf("{{\\"filtergym\\": 1, \\"format\\": \\"float64\\"%s}}\\n", steers ? ", \\"feedback\\": true" : "");
    fflush(stdout);
    if (fread(rows, INITIAL * sizeof *rows, (size_t)tracks, stdin) != (size_t)tracks) return 0;
    for (t = 0; t < tracks; ++t) {{
        {own}_initial initial;
        set_initial(&initial, rows + t * INITIAL);
        {own}_start(&states[t], &initial, NULL);
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
    return 0;
}}

/* Reads the hello, and writes estimates. */
static int serve(void) {{
    const long tracks = number_of("\\"tracks\\": ");
    const int steers = FEEDBACK > 0 && number_of("\\"feedback\\": ") == FEEDBACK;
    {own}_state *states;
    double *rows, *last;
    int status = 2;
    if (number_of("\\"filtergym\\": ") != 1 || number_of("\\"initial\\": ") != INITIAL ||
        number_of("\\"measurement\\": ") != MEASUREMENT || number_of("\\"answer\\": ") != ANSWER ||
        tracks < 1) {{
        puts("{{\\"error\\": \\"this filter was exported from another environment or scenario\\"}}");
        return 2;
    }}
    while (strchr(line, '\\n') == NULL && fgets(line, (int)sizeof line, stdin) != NULL) {{
    }}
    states = calloc((size_t)tracks, sizeof *states);
    rows = calloc((size_t)tracks, (INITIAL + MEASUREMENT + ANSWER + FEEDBACK) * sizeof *rows);
    last = calloc((size_t)tracks, MEASUREMENT * sizeof *last);
    if (states != NULL && rows != NULL && last != NULL) status = answer_all(tracks, steers, states, rows, last);
    free(states);
    free(rows);
    free(last);
    return status;
}}

{layout}
static void print_number(double value) {{
    if (value == value)
        printf(",%.{digits}g", value);
    else
        printf(",nan");
}}

/* Writes the estimates of a table; refused or rejected rows have none, and the status is then 1. */
static int estimate_rows(FILE *file) {{
    static {own}_state state;
    static double row[COLUMNS];
    long track = 0, measurement = 0, number = 1, failed = 0;
    if (strncmp(line, columns, strlen(columns)) != 0 || strcspn(line, "\\r\\n") != strlen(columns)) {{
        fprintf(stderr, "the first line must be %s\\n", columns);
        return 2;
    }}
    puts({header});
    while (fgets(line, (int)sizeof line, file) != NULL) {{
        {own}_measurement measurement_now;
        {own}_estimate estimate;
        int i, count, there;
        ++number;
        if (line[strspn(line, "\\r\\n")] == '\\0') continue;
        count = numbers(line, row);
        if (count < 0) {{
            fprintf(stderr, "line %ld: cell %d is no number\\n", number, -count);
            return 2;
        }}
        if (count != COLUMNS) {{
            fprintf(stderr, "line %ld must have %d numbers\\n", number, COLUMNS);
            return 2;
        }}
        if (begins(row)) {{
            {own}_initial initial;
            set_initial(&initial, initial_of(row));
            {own}_start(&state, &initial, NULL);
            ++track;
            measurement = 0;
        }}
        if (track == 0) {{
            fprintf(stderr, "line 2 must begin a track\\n");
            return 2;
        }}
        set_measurement(&measurement_now, measurement_of(row));
        there = {own}_update(&state, &measurement_now, &estimate) < {upper}_REJECTED;
        if (!there && failed == 0) failed = number;
        printf("%ld,%ld", track, ++measurement);{likelihoods}
        for (i = 0; i < {C}; ++i) print_number(there ? (double)estimate.mean{mean} : (double)NAN);
        for (i = 0; i < {C}; ++i) print_number(there ? sqrt((double)estimate.covariance{covariance}) : (double)NAN);
        putchar('\\n');
    }}
    if (failed > 0) fprintf(stderr, "measurements were rejected or refused, the first in line %ld\\n", failed);
    return failed > 0;
}}

int main(int argc, char **argv) {{
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    int status;
    if (file == NULL) {{
        fprintf(stderr, "cannot read %s\\n", argv[1]);
        return 2;
    }}
    line[0] = '\\0';
    if (fgets(line, (int)sizeof line, file) != NULL && file == stdin && line[0] == '{{') return serve();
    status = estimate_rows(file);
    if (file != stdin) fclose(file);
    return status;
}}
"""
"""Reads a table of measurements and writes one of estimates."""
INITIAL_IN_ROW = """/* Whether a row begins a track, its initial estimate, and its measurement. */
static int begins(const double *row) {{ return row[0] == row[0]; }}
static const double *initial_of(const double *row) {{ return row; }}
static const double *measurement_of(const double *row) {{ return row + INITIAL; }}
"""
"""Layout of the rows of a table with the initial estimate in the first row of a track, and every number of a
measurement.
"""
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
"""Layout of the rows of a table with the columns of a log, where the model contains the initial estimate."""
TEST = """/* Compares the filter with the estimates of the competitor itself, and prints the time of an update. */
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
        {own}_start(&state, &initial, NULL);
        for (k = track * MEASUREMENTS; k < (track + 1) * MEASUREMENTS; ++k) {{
            {own}_measurement measurement;
            {own}_estimate estimate;
            set_measurement(&measurement, measurements[k]);
            if ({own}_update(&state, &measurement, &estimate) >= {upper}_REJECTED) return HUGE_VAL;
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
