"""Programs of C that read a log as filtergym reads it, with fields for what differs from filter to filter.

:data:`LOG` reads the whole file into rows, sorts them into tracks and leaves out what comes twice. It calls ``follow``
for each track, which is :data:`PLOTS` or :data:`PLAIN_ROWS`. Their numbers and names are from :mod:`.c_log`.
"""

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

#include "{include}.h"

/* --- The reading, as filtergym declares it. */

{reading}
#define COLUMNS {count}
#define NEEDED {needed} /* The first ones; others may lack. */

/* Names of the columns, in lower case: of the times, of which the first counts, and of numbers. */
static const char *const times[] = {{{times}}};
static const char *const names[COLUMNS] = {{{names}}};
static const char recordings[] = {recording};
static const char delimiters[] = {delimiters};
static const double units[] = {{{units}}}; /* Of a second, in which numbers since 1970 may count. */

/* --- The file. */

typedef struct Row {{
    double time, written;          /* s; as in the file, NaN where it is in words */
    const char *words, *recording; /* of the time and of the recording */
    long number, line, track;      /* rows count from 0 without the names, lines from 1 */
    struct Row *again;             /* the next row of the same time */
    int copy;                      /* what became of a row of the time of another one */
    double cell[COLUMNS];{members}
}} Row;

enum {{ TAKEN, MISSED, REJECTED, REFUSED, JOINED, REPEATED }};
static const char *const statuses[] = {{"taken", "missed", "rejected", "refused", "joined", "repeated"}};

static char *text, *place, *cells[MOST_COLUMNS], delimiter;
static Row *rows, **own;
static const Row *failed;
static double *sorted;
static long count, line, next_line = 1, failures;
static int column[COLUMNS], time_column = -1, recording_column = -1, width, separators[COLUMNS + 1];

static int fail(const char *what, const char *why, const Row *row) {{
    fprintf(stderr, "%s %s", what, why);
    if (row != NULL) fprintf(stderr, " in row %ld (line %ld)", row->number, row->line);
    fputc('\\n', stderr);
    return 2;
}}

static int fail_cell(const char *name, const char *cell, const Row *row, const char *why) {{
    int i;
    fprintf(stderr, "%s has '", name);
    for (i = 0; i < 40 && cell[i] != '\\0'; ++i) fputc(cell[i] >= ' ' && cell[i] <= '~' ? cell[i] : '?', stderr);
    fprintf(stderr, "' in row %ld (line %ld), %s\\n", row->number, row->line, why);
    return 2;
}}

static int read_text(FILE *file) {{
    size_t size = 0, room = 0, got;
    do {{
        if (room - size < 2) {{
            char *more = realloc(text, 2 * room + 65536);
            if (more == NULL) return fail("it needs", "more memory", NULL);
            text = more;
            room = 2 * room + 65536;
        }}
        got = fread(text + size, 1, room - size - 1, file);
        size += got;
    }} while (got > 0);
    text[size] = '\\0';
    if (ferror(file) || memchr(text, '\\0', size) != NULL) return fail("it is", "no text", NULL);
    place = text;
    if (strncmp(text, "\\xEF\\xBB\\xBF", 3) == 0) place += 3;
    return 0;
}}

/* Splits the next row into cells, without their quotes. Returns how many there are: 0 of an empty line, -1 at the end,
   -2 where they are too many. */
static int read_row(void) {{
    enum {{ BEGINS, PLAIN, QUOTED, CLOSED }} state = BEGINS;
    char *to = place;
    int n = 0;
    if (*place == '\\0') return -1;
    line = next_line;
    cells[0] = to;
    for (;;) {{
        char c = *place;
        if (c != '\\0') ++place;
        if (c == '\\r' || c == '\\n') {{
            if (c == '\\r' && *place == '\\n') ++place;
            c = '\\n';
            ++next_line;
        }}
        if (state == QUOTED && c != '\\0') {{
            if (c == '"')
                state = CLOSED;
            else
                *to++ = c;
        }} else if (c == '"' && (state == BEGINS || state == CLOSED)) {{
            if (state == CLOSED) *to++ = c;
            state = QUOTED;
        }} else if (c == delimiter || c == '\\n' || c == '\\0') {{
            if (c != delimiter && n == 0 && state == BEGINS) return 0;
            *to++ = '\\0';
            ++n;
            if (c != delimiter) return n;
            if (n == MOST_COLUMNS) return -2;
            cells[n] = to;
            state = BEGINS;
        }} else {{
            *to++ = c;
            state = PLAIN;
        }}
    }}
}}

/* Finds the columns in the first line; names are read without regard to case. */
static int find_columns(void) {{
    const size_t length = strcspn(place, "\\r\\n");
    int best = (int)(sizeof times / sizeof *times), c, k;
    const char *d = delimiters;
    while (*d != '\\0' && memchr(place, *d, length) == NULL) ++d;
    delimiter = *d != '\\0' ? *d : delimiters[0];
    for (k = 0; k < COLUMNS; ++k) column[k] = -1;
    width = read_row();
    for (c = 0; c < width; ++c) {{
        char *name = cells[c], *at;
        while (*name == ' ' || *name == '\\t') ++name;
        for (at = name + strlen(name); at > name && (at[-1] == ' ' || at[-1] == '\\t');) *--at = '\\0';
        for (at = name; *at != '\\0'; ++at)
            if (*at >= 'A' && *at <= 'Z') *at = (char)(*at - 'A' + 'a');
        for (k = 0; k < best; ++k)
            if (strcmp(name, times[k]) == 0) {{
                best = k;
                time_column = c;
            }}
        if (strcmp(name, recordings) == 0) recording_column = c;
        for (k = 0; k < COLUMNS; ++k)
            if (strcmp(name, names[k]) == 0) {{
                if (column[k] >= 0) return fail("it has more than once the column", names[k], NULL);
                column[k] = c;
            }}
    }}
    if (time_column < 0) return fail("it lacks the column", times[0], NULL);
    for (k = 0; k < NEEDED; ++k)
        if (column[k] < 0) return fail("it lacks the column", names[k], NULL);
    return 0;
}}

/* Number in a cell, NaN in an empty one; returns whether it is either. A column has commas or points. */
static int number(const char *cell, int k, double *value) {{
    char digits[LONGEST_CELL + 1], *end;
    const size_t length = strlen(cell);
    size_t i;
    *value = (double)NAN;
    if (length == 0 || strcmp(cell, "nan") == 0 || strcmp(cell, "NaN") == 0 || strcmp(cell, "NAN") == 0) return 1;
    if (length > LONGEST_CELL) return 0;
    for (i = 0; i <= length; ++i) {{
        digits[i] = cell[i];
        if (cell[i] == ',' && delimiter != ',' && cell[i + 1] >= '0' && cell[i + 1] <= '9') {{
            digits[i] = '.';
            separators[k] |= 1;
        }} else if (strchr("+-.0123456789eE \\t", cell[i]) == NULL) {{
            return 0;
        }} else if (cell[i] == '.') {{
            separators[k] |= 2;
        }}
    }}
    *value = strtod(digits, &end);
    if (end == digits || separators[k] == 3) return 0;
    return end[strspn(end, " \\t")] == '\\0';
}}

/* Reads a whole number of so many digits at a place, and moves on; returns whether there is one. */
static int whole(const char **at, int fewest, int most, long *value) {{
    int n = 0;
    for (*value = 0; n < most && **at >= '0' && **at <= '9'; ++n) *value = 10 * *value + (*(*at)++ - '0');
    return n >= fewest;
}}

/* Reads a time of day in nanoseconds: hours, minutes and seconds, of which so many must be there, with colons or
   without, and a fraction. */
static int read_clock(const char **at, int fewest, int parts, long long *time) {{
    long part[3] = {{0, 0, 0}}, digit;
    long long unit = 1000000000LL;
    int colon, n;
    if (!whole(at, fewest, 2, part)) return 0;
    colon = **at == ':';
    for (n = 1; n < 3 && (colon ? **at == ':' : **at >= '0' && **at <= '9'); ++n) {{
        *at += colon;
        if (!whole(at, 2, 2, part + n)) return 0;
    }}
    *time = (part[0] * 3600LL + part[1] * 60LL + part[2]) * unit;
    if (n == 3 && (**at == '.' || **at == ',') && (*at)[1] >= '0' && (*at)[1] <= '9')
        for (++*at; whole(at, 1, 1, &digit);) *time += digit * (unit /= 10);
    return n >= parts && part[0] < 24 && part[1] < 60 && part[2] < 60;
}}

/* Reads a date in nanoseconds since 1970: ISO 8601, year/month/day or day.month.year, and perhaps a time of day and its
   offset from UTC. */
static int read_date(const char *cell, long long *time, int *offset) {{
    static const int lengths[] = {{31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31}};
    const char *at = cell + strspn(cell, " \\t"), *begin = at;
    long year, month, day, era, hours, minutes = 0;
    long long clock = 0;
    *offset = 0;
    if (whole(&at, 4, 4, &year)) {{
        const char mark = *at == '-' || *at == '/' ? *at : '\\0';
        at += mark != '\\0';
        if (!whole(&at, mark == '/' ? 1 : 2, 2, &month) || (mark != '\\0' && *at++ != mark)) return 0;
        if (!whole(&at, mark == '/' ? 1 : 2, 2, &day)) return 0;
    }} else {{
        at = begin;
        if (!whole(&at, 1, 2, &day) || *at++ != '.' || !whole(&at, 1, 2, &month) || *at++ != '.') return 0;
        if (!whole(&at, 4, 4, &year)) return 0;
    }}
    if (year < 1678 || year > 2261 || month < 1 || month > 12 || day < 1) return 0;
    if (day > lengths[month - 1] + (month == 2 && year % 4 == 0 && (year % 100 != 0 || year % 400 == 0))) return 0;
    if ((*at == 'T' || *at == ' ') && at[1] >= '0' && at[1] <= '9') {{
        ++at;
        if (!read_clock(&at, 2, 1, &clock)) return 0;
        if (*at == 'Z' || *at == 'z') {{
            ++at;
            *offset = 1;
        }} else if (*at == '+' || *at == '-') {{
            const long long sign = *at++ == '-' ? 1 : -1;
            if (!whole(&at, 2, 2, &hours)) return 0;
            at += *at == ':';
            if (*at >= '0' && *at <= '9' && !whole(&at, 2, 2, &minutes)) return 0;
            clock += sign * (hours * 3600LL + minutes * 60LL) * 1000000000LL;
            *offset = 1;
        }}
    }}
    if (at[strspn(at, " \\t")] != '\\0') return 0;
    /* Days since 1970, of a year that begins in March. */
    year -= month <= 2;
    era = year / 400;
    day += (153 * (month + (month > 2 ? -3 : 9)) + 2) / 5 - 1;
    day += (year - 400 * era) * 365 + (year - 400 * era) / 4 - (year - 400 * era) / 100 + 146097 * era - 719468;
    *time = day * 86400000000000LL + clock;
    return 1;
}}

/* Reads the time of a row: in words, if the first is no number; of dates since the first, of times of day through
   midnight. */
static int read_time(const char *cell, Row *row) {{
    static enum {{ NUMBERS, CLOCKS, DATES }} kind;
    static double first, unit = 1.0, before, days;
    static long long first_date;
    static int first_offset;
    long long time;
    int offset, i;
    const char *at = cell + strspn(cell, " \\t");
    if (*at == '\\0') return fail(times[0], "has no value", row);
    if (count == 0) {{
        kind = number(cell, COLUMNS, &first) && first == first ? NUMBERS : DATES;
        for (i = (int)(sizeof units / sizeof *units) - 1; i >= 0; --i)
            if (first > SINCE_1970 * units[i]) unit = units[i];
        if (kind == DATES && read_clock(&at, 1, 3, &time) && at[strspn(at, " \\t")] == '\\0') kind = CLOCKS;
        at = cell + strspn(cell, " \\t");
    }}
    row->words = kind == NUMBERS ? NULL : cell;
    row->written = (double)NAN;
    if (kind == NUMBERS) {{
        if (!number(cell, COLUMNS, &row->written) || !isfinite(row->written))
            return fail_cell(times[0], cell, row, "which is no number of seconds");
        row->time = unit > 1.0 ? (row->written - first) / unit : row->written;
    }} else if (kind == CLOCKS) {{
        if (!read_clock(&at, 1, 3, &time) || at[strspn(at, " \\t")] != '\\0')
            return fail_cell(times[0], cell, row, "which is no time of day such as 12:00:00");
        row->time = (double)time / 1e9;
        if (count > 0 && row->time - before < -0.5 * DAY) days += 1.0;
        before = row->time;
        row->time += DAY * days;
    }} else {{
        if (!read_date(cell, &time, &offset))
            return fail_cell(times[0], cell, row, "which is neither seconds nor a date such as 2026-05-01T12:00:00Z");
        if (count == 0) {{
            first_date = time;
            first_offset = offset;
        }}
        if (offset != first_offset)
            return fail_cell(times[0], cell, row, "with an offset from UTC where others have none, or without it");
        row->time = (double)(time - first_date) / 1e9;
    }}
    return 0;
}}

static int read_rows(void) {{
    static const Row none;
    long room = 0;
    int n, k, wrong;
    while ((n = read_row()) != -1) {{
        Row *row;
        if (n == 0) continue;
        if (count == room) {{
            Row *more = realloc(rows, (size_t)(2 * room + 1024) * sizeof *rows);
            if (more == NULL) return fail("it needs", "more memory", NULL);
            rows = more;
            room = 2 * room + 1024;
        }}
        row = rows + count;
        *row = none;
        row->number = count;
        row->line = line;
        if (n != width) return fail("there are not as many cells as names", "of columns", row);
        if ((wrong = read_time(cells[time_column], row)) != 0) return wrong;
        row->recording = recording_column < 0 ? "" : cells[recording_column];
        for (k = 0; k < COLUMNS; ++k) {{
            row->cell[k] = (double)NAN;
            if (column[k] < 0) continue;
            if (!number(cells[column[k]], k, row->cell + k))
                return fail_cell(names[k], cells[column[k]], row,
                                 separators[k] == 3 ? "and this column has decimal commas and points"
                                                    : "which is no number");
            if (fabs(row->cell[k]) > LARGEST) return fail_cell(names[k], cells[column[k]], row, "which is too large");
        }}
        ++count;
    }}
    if (count < 2) return fail("it has no two", "rows", NULL);
    own = malloc((size_t)count * sizeof *own);
    sorted = malloc((size_t)count * sizeof *sorted);
    return own == NULL || sorted == NULL ? fail("it needs", "more memory", NULL) : 0;
}}

/* Numbers the recordings in the order in which they begin; returns how many there are. */
static long find_tracks(void) {{
    long tracks = 0, i, t;
    for (i = 0; i < count; ++i) {{
        t = i > 0 ? rows[i - 1].track : 0;
        if (i == 0 || strcmp(rows[i].recording, rows[i - 1].recording) != 0)
            for (t = 0; t < tracks && strcmp(rows[i].recording, own[t]->recording) != 0;) ++t;
        if (t == tracks) own[tracks++] = rows + i;
        rows[i].track = t;
    }}
    return tracks;
}}

/* Leaves out rows that have the time of the row before, and joins them with it where they supply each other. */
static int join_rows(long *n) {{
    long kept = 0, left = 0, differing = 0, i, j, q;
    int k;
    for (i = 0; i < *n; i = j) {{
        Row *head = own[i];
        double joined[COLUMNS];
        int supplied = 0, differ = 0;
        memcpy(joined, head->cell, sizeof joined);
        for (j = i + 1; j < *n && own[j]->time == head->time; ++j)
            for (k = 0; k < COLUMNS; ++k) {{
                const double value = own[j]->cell[k];
                supplied |= value == value && joined[k] != joined[k];
                differ |= value == value && joined[k] == joined[k] && value != joined[k];
                if (joined[k] != joined[k]) joined[k] = value;
            }}
        supplied = supplied && !differ;
        for (q = i + 1; q < j; ++q) {{
            own[q]->copy = supplied ? JOINED : REPEATED;
            own[q - 1]->again = own[q];
            for (k = 0, differ = 0; k < COLUMNS; ++k)
                differ |= own[q]->cell[k] != head->cell[k] &&
                          (own[q]->cell[k] == own[q]->cell[k] || head->cell[k] == head->cell[k]);
            left += !supplied;
            differing += !supplied && differ;
        }}
        if (supplied) memcpy(head->cell, joined, sizeof joined);
        own[kept++] = head;
    }}
    if ((double)differing > MOST_TWICE * (double)(kept + left))
        return fail("many rows have the time of the row before and other values: write",
                    "times with their fractions of a second", NULL);
    *n = kept;
    return 0;
}}

static int ascending(const void *a, const void *b) {{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}}

/* Median of the first n of the numbers to be sorted. */
static double median(long n) {{
    qsort(sorted, (size_t)n, sizeof *sorted, ascending);
    return 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]);
}}

/* Writes words as a cell of CSV. */
static void print_words(const char *words) {{
    const int quoted = strpbrk(words, ",\\"\\r\\n") != NULL;
    if (quoted) putchar('"');
    for (; *words != '\\0'; ++words) {{
        if (*words == '"') putchar('"');
        putchar(*words);
    }}
    if (quoted) putchar('"');
}}

/* Writes what became of a row, and of those that have its time. */
static void print_row(const Row *row, int status, const {own}_estimate *estimate) {{
    int i;
    for (; row != NULL; row = row->again) {{
        if (row->copy != 0) status = row->copy;
        if (recording_column >= 0) {{
            print_words(row->recording);
            putchar(',');
        }}
        if (row->words != NULL)
            print_words(row->words);
        else
            printf("%.17g", row->written);
        printf(",%s", statuses[status]);
        for (i = 0; i < {C}; ++i)
            if (status <= MISSED)
                printf(",%.{digits}g", (double)estimate->mean{mean});
            else
                putchar(',');
        for (i = 0; i < {C}; ++i)
            if (status <= MISSED)
                printf(",%.{digits}g", sqrt((double)estimate->covariance{covariance}));
            else
                putchar(',');
        putchar('\\n');
    }}
}}

/* Notes what an update returned. */
static int note(const Row *row, int status) {{
    if (status == REJECTED || status == REFUSED) {{
        if (failures++ == 0) failed = row;
    }}
    return status;
}}

/* --- The track. */

static {own}_state state;

{follow}
int main(int argc, char **argv) {{
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : stdin;
    long tracks = 0, t, i, n;
    int wrong;
    if (file == NULL) return fail("cannot read", argv[1], NULL);
    wrong = read_text(file);
    if (file != stdin) fclose(file);
    if (wrong == 0) wrong = find_columns();
    if (wrong == 0) wrong = read_rows();
    if (wrong == 0) tracks = find_tracks();
    if (wrong == 0) printf("%s%s\\n", recording_column < 0 ? "" : "recording,", {header});
    for (t = 0; t < tracks && wrong == 0; ++t) {{
        for (i = 0, n = 0; i < count; ++i)
            if (rows[i].track == t) own[n++] = rows + i;
        for (i = 1; i < n && wrong == 0; ++i)
            if (own[i]->time < own[i - 1]->time) wrong = fail(times[0], "decreases", own[i]);
        if (wrong == 0) wrong = join_rows(&n);
        if (wrong == 0 && n < 2) wrong = fail("a recording has no two", "rows", own[0]);
        if (wrong == 0) wrong = follow(n);
    }}
    if (failures > 0) {{
        fprintf(stderr, "%ld measurements were rejected or refused and left the state as it was, the first", failures);
        if (wrong == 0) wrong = fail("", "was", failed) - 1;
    }}
    if (fflush(stdout) != 0 && wrong == 0) wrong = fail("cannot", "write", NULL);
    free(text);
    free(rows);
    free(own);
    free(sorted);
    return wrong;
}}
"""
"""Reads a log, and writes an estimate for each row."""
MEMBERS = """
    double p[2], v[2], m[2]; /* position, m east and north, its variances, and as it was measured */
    double moved[2];         /* since the row before, m east and north, by a second sensor */
    int plot, odometry;      /* whether these are there */"""
"""Of a row that may hold a plot."""
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
"""How a displacement is made of the columns a and b of a second sensor, the first pair that a log has."""
READ_ODOMETRY = """
/* Makes displacements of the rows of a track, of which those that lack a number have none. */
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
POSITIONS = {
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
"""How a position is made of the columns a and b of a log, the first pair that it has; a third one may lack."""
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
/* Empties positions that are those of the row before, where noise would hardly ever give both numbers again. */
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

/* Takes in a scan: the last one of several until a row, or one before that misses the target. */
static int step(double at, const Row *row, double scans, int is_last, {own}_estimate *estimate) {{
    static const double none[2] = {{0.0, 0.0}}, nominal[2] = {{{nominal}, {nominal}}};
    const double interval = at - last, elapsed = at - last_plot, available = is_last && row->plot ? 1.0 : 0.0;
    const double *p = available > 0.0 ? row->p : none, *v = available > 0.0 ? row->v : nominal;
    {own}_measurement m;
    int status;
    (void)interval;
    (void)elapsed;
    (void)p;
    (void)v;
    (void)scans;
    {fill}
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
        {own}_estimate estimate;
        double scans, begun, k;
        if (plots < 2) {{
            const double *p = row->p, *v = row->v;
            if (!row->plot) continue;
            if (++plots == 2) {{
                const double lasted = row->time - last;
                {own}_initial initial;
                {start}
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

static int step(double interval, const double *row, const double *held, {own}_estimate *estimate) {{
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
        {own}_estimate estimate;
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
