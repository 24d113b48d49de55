typedef struct Row {
    double time, written;          /* s; as in the file, NaN where it is in words */
    const char *words, *recording; /* of the time and of the recording */
    long number, line, track;      /* rows count from 0 without the names, lines from 1 */
    struct Row *again;             /* the next row of the same time */
    int copy;                      /* status of a row with the time of another one */
    double cell[COLUMNS];
#ifdef FARTHEST /* Rows may hold plots. */
    double p[2], v[2], m[2]; /* position, m east and north, its variances, and as it was measured */
    double moved[2];         /* since the row before, m east and north, by a second sensor */
    int plot, odometry;      /* whether these exist */
#endif
} Row;

enum { TAKEN, MISSED, REJECTED, REFUSED, JOINED, REPEATED };
static const char *const statuses[] = {"taken", "missed", "rejected", "refused", "joined", "repeated"};

static char *text, *place, *cells[MOST_COLUMNS], delimiter;
static Row *rows, **own;
static const Row *failed;
static double *sorted;
static long count, line, next_line = 1, failures;
static int column[COLUMNS], time_column = -1, recording_column = -1, width, separators[COLUMNS + 1];

static int fail(const char *what, const char *why, const Row *row) {
    fprintf(stderr, "%s %s", what, why);
    if (row != NULL) fprintf(stderr, " in row %ld (line %ld)", row->number, row->line);
    fputc('\n', stderr);
    return 2;
}

static int fail_cell(const char *name, const char *cell, const Row *row, const char *why) {
    int i;
    fprintf(stderr, "%s has '", name);
    for (i = 0; i < 40 && cell[i] != '\0'; ++i) fputc(cell[i] >= ' ' && cell[i] <= '~' ? cell[i] : '?', stderr);
    fprintf(stderr, "' in row %ld (line %ld), %s\n", row->number, row->line, why);
    return 2;
}

static int read_text(FILE *file) {
    size_t size = 0, room = 0, got;
    do {
        if (room - size < 2) {
            char *more = realloc(text, 2 * room + 65536);
            if (more == NULL) return fail("it needs", "more memory", NULL);
            text = more;
            room = 2 * room + 65536;
        }
        got = fread(text + size, 1, room - size - 1, file);
        size += got;
    } while (got > 0);
    text[size] = '\0';
    if (ferror(file) || memchr(text, '\0', size) != NULL) return fail("it is", "no text", NULL);
    place = text;
    if (strncmp(text, "\xEF\xBB\xBF", 3) == 0) place += 3;
    return 0;
}

/* Splits the next row into cells, without their quotes. Returns how many there are: 0 of an empty line, -1 at the end,
   -2 where they are too many. */
static int read_row(void) {
    enum { BEGINS, PLAIN, QUOTED, CLOSED } state = BEGINS;
    char *to = place;
    int n = 0;
    if (*place == '\0') return -1;
    line = next_line;
    cells[0] = to;
    for (;;) {
        char c = *place;
        if (c != '\0') ++place;
        if (c == '\r' || c == '\n') {
            if (c == '\r' && *place == '\n') ++place;
            c = '\n';
            ++next_line;
        }
        if (state == QUOTED && c != '\0') {
            if (c == '"')
                state = CLOSED;
            else
                *to++ = c;
        } else if (c == '"' && (state == BEGINS || state == CLOSED)) {
            if (state == CLOSED) *to++ = c;
            state = QUOTED;
        } else if (c == delimiter || c == '\n' || c == '\0') {
            if (c != delimiter && n == 0 && state == BEGINS) return 0;
            *to++ = '\0';
            ++n;
            if (c != delimiter) return n;
            if (n == MOST_COLUMNS) return -2;
            cells[n] = to;
            state = BEGINS;
        } else {
            *to++ = c;
            state = PLAIN;
        }
    }
}

/* Finds the columns in the first line; names are read without regard to case. */
static int find_columns(void) {
    const size_t length = strcspn(place, "\r\n");
    int best = (int)(sizeof times / sizeof *times), c, k;
    const char *d = delimiters;
    while (*d != '\0' && memchr(place, *d, length) == NULL) ++d;
    delimiter = *d != '\0' ? *d : delimiters[0];
    for (k = 0; k < COLUMNS; ++k) column[k] = -1;
    width = read_row();
    for (c = 0; c < width; ++c) {
        char *name = cells[c], *at;
        while (*name == ' ' || *name == '\t') ++name;
        for (at = name + strlen(name); at > name && (at[-1] == ' ' || at[-1] == '\t');) *--at = '\0';
        for (at = name; *at != '\0'; ++at)
            if (*at >= 'A' && *at <= 'Z') *at = (char)(*at - 'A' + 'a');
        for (k = 0; k < best; ++k)
            if (strcmp(name, times[k]) == 0) {
                best = k;
                time_column = c;
            }
        if (strcmp(name, recordings) == 0) recording_column = c;
        for (k = 0; k < COLUMNS; ++k)
            if (strcmp(name, names[k]) == 0) {
                if (column[k] >= 0) return fail("it has more than once the column", names[k], NULL);
                column[k] = c;
            }
    }
    if (time_column < 0) return fail("it lacks the column", times[0], NULL);
    for (k = 0; k < NEEDED; ++k)
        if (column[k] < 0) return fail("it lacks the column", names[k], NULL);
    return 0;
}

/* Number in a cell, NaN in an empty one; returns whether it is either. A column has commas or points. */
static int number(const char *cell, int k, double *value) {
    char digits[LONGEST_CELL + 1], *end;
    const size_t length = strlen(cell);
    size_t i;
    *value = (double)NAN;
    if (length == 0 || strcmp(cell, "nan") == 0 || strcmp(cell, "NaN") == 0 || strcmp(cell, "NAN") == 0) return 1;
    if (length > LONGEST_CELL) return 0;
    for (i = 0; i <= length; ++i) {
        digits[i] = cell[i];
        if (cell[i] == ',' && delimiter != ',' && cell[i + 1] >= '0' && cell[i + 1] <= '9') {
            digits[i] = '.';
            separators[k] |= 1;
        } else if (strchr("+-.0123456789eE \t", cell[i]) == NULL) {
            return 0;
        } else if (cell[i] == '.') {
            separators[k] |= 2;
        }
    }
    *value = strtod(digits, &end);
    if (end == digits || separators[k] == 3) return 0;
    return end[strspn(end, " \t")] == '\0';
}

/* Reads a whole number of so many digits at a place, and moves on; returns whether there is one. */
static int whole(const char **at, int fewest, int most, long *value) {
    int n = 0;
    for (*value = 0; n < most && **at >= '0' && **at <= '9'; ++n) *value = 10 * *value + (*(*at)++ - '0');
    return n >= fewest;
}

/* Reads a time of day in nanoseconds: hours, minutes and seconds, of which so many must be there, with colons or
   without, and a fraction. */
static int read_clock(const char **at, int fewest, int parts, long long *time) {
    long part[3] = {0, 0, 0}, digit;
    long long unit = 1000000000LL;
    int colon, n;
    if (!whole(at, fewest, 2, part)) return 0;
    colon = **at == ':';
    for (n = 1; n < 3 && (colon ? **at == ':' : **at >= '0' && **at <= '9'); ++n) {
        *at += colon;
        if (!whole(at, 2, 2, part + n)) return 0;
    }
    *time = (part[0] * 3600LL + part[1] * 60LL + part[2]) * unit;
    if (n == 3 && (**at == '.' || **at == ',') && (*at)[1] >= '0' && (*at)[1] <= '9')
        for (++*at; whole(at, 1, 1, &digit);) *time += digit * (unit /= 10);
    return n >= parts && part[0] < 24 && part[1] < 60 && part[2] < 60;
}

/* Reads a date in nanoseconds since 1970: ISO 8601, year/month/day or day.month.year, and perhaps a time of day and its
   offset from UTC. */
static int read_date(const char *cell, long long *time, int *offset) {
    static const int lengths[] = {31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31};
    const char *at = cell + strspn(cell, " \t"), *begin = at;
    long year, month, day, era, hours, minutes = 0;
    long long clock = 0;
    *offset = 0;
    if (whole(&at, 4, 4, &year)) {
        const char mark = *at == '-' || *at == '/' ? *at : '\0';
        at += mark != '\0';
        if (!whole(&at, mark == '/' ? 1 : 2, 2, &month) || (mark != '\0' && *at++ != mark)) return 0;
        if (!whole(&at, mark == '/' ? 1 : 2, 2, &day)) return 0;
    } else {
        at = begin;
        if (!whole(&at, 1, 2, &day) || *at++ != '.' || !whole(&at, 1, 2, &month) || *at++ != '.') return 0;
        if (!whole(&at, 4, 4, &year)) return 0;
    }
    if (year < 1678 || year > 2261 || month < 1 || month > 12 || day < 1) return 0;
    if (day > lengths[month - 1] + (month == 2 && year % 4 == 0 && (year % 100 != 0 || year % 400 == 0))) return 0;
    if ((*at == 'T' || *at == ' ') && at[1] >= '0' && at[1] <= '9') {
        ++at;
        if (!read_clock(&at, 2, 1, &clock)) return 0;
        if (*at == 'Z' || *at == 'z') {
            ++at;
            *offset = 1;
        } else if (*at == '+' || *at == '-') {
            const long long sign = *at++ == '-' ? 1 : -1;
            if (!whole(&at, 2, 2, &hours)) return 0;
            at += *at == ':';
            if (*at >= '0' && *at <= '9' && !whole(&at, 2, 2, &minutes)) return 0;
            clock += sign * (hours * 3600LL + minutes * 60LL) * 1000000000LL;
            *offset = 1;
        }
    }
    if (at[strspn(at, " \t")] != '\0') return 0;
    /* Days since 1970, of a year that begins in March. */
    year -= month <= 2;
    era = year / 400;
    day += (153 * (month + (month > 2 ? -3 : 9)) + 2) / 5 - 1;
    day += (year - 400 * era) * 365 + (year - 400 * era) / 4 - (year - 400 * era) / 100 + 146097 * era - 719468;
    *time = day * 86400000000000LL + clock;
    return 1;
}

/* Reads the time of a row: in words, if the first is no number; of dates since the first, of times of day through
   midnight. */
static int read_time(const char *cell, Row *row) {
    static enum { NUMBERS, CLOCKS, DATES } kind;
    static double first, unit = 1.0, before, days;
    static long long first_date;
    static int first_offset;
    long long time;
    int offset, i;
    const char *at = cell + strspn(cell, " \t");
    if (*at == '\0') return fail(times[0], "has no value", row);
    if (count == 0) {
        kind = number(cell, COLUMNS, &first) && first == first ? NUMBERS : DATES;
        for (i = (int)(sizeof units / sizeof *units) - 1; i >= 0; --i)
            if (first > SINCE_1970 * units[i]) unit = units[i];
        if (kind == DATES && read_clock(&at, 1, 3, &time) && at[strspn(at, " \t")] == '\0') kind = CLOCKS;
        at = cell + strspn(cell, " \t");
    }
    row->words = kind == NUMBERS ? NULL : cell;
    row->written = (double)NAN;
    if (kind == NUMBERS) {
        if (!number(cell, COLUMNS, &row->written) || !isfinite(row->written))
            return fail_cell(times[0], cell, row, "which is no number of seconds");
        row->time = unit > 1.0 ? (row->written - first) / unit : row->written;
    } else if (kind == CLOCKS) {
        if (!read_clock(&at, 1, 3, &time) || at[strspn(at, " \t")] != '\0')
            return fail_cell(times[0], cell, row, "which is no time of day such as 12:00:00");
        row->time = (double)time / 1e9;
        if (count > 0 && row->time - before < -0.5 * DAY) days += 1.0;
        before = row->time;
        row->time += DAY * days;
    } else {
        if (!read_date(cell, &time, &offset))
            return fail_cell(times[0], cell, row, "which is neither seconds nor a date such as 2026-05-01T12:00:00Z");
        if (count == 0) {
            first_date = time;
            first_offset = offset;
        }
        if (offset != first_offset)
            return fail_cell(times[0], cell, row, "with an offset from UTC where others have none, or without it");
        row->time = (double)(time - first_date) / 1e9;
    }
    return 0;
}

static int read_rows(void) {
    static const Row none;
    long room = 0;
    int n, k, wrong;
    while ((n = read_row()) != -1) {
        Row *row;
        if (n == 0) continue;
        if (count == room) {
            Row *more = realloc(rows, (size_t)(2 * room + 1024) * sizeof *rows);
            if (more == NULL) return fail("it needs", "more memory", NULL);
            rows = more;
            room = 2 * room + 1024;
        }
        row = rows + count;
        *row = none;
        row->number = count;
        row->line = line;
        if (n != width) return fail("there are not as many cells as names", "of columns", row);
        if ((wrong = read_time(cells[time_column], row)) != 0) return wrong;
        row->recording = recording_column < 0 ? "" : cells[recording_column];
        for (k = 0; k < COLUMNS; ++k) {
            row->cell[k] = (double)NAN;
            if (column[k] < 0) continue;
            if (!number(cells[column[k]], k, row->cell + k))
                return fail_cell(names[k], cells[column[k]], row,
                                 separators[k] == 3 ? "and this column has decimal commas and points"
                                                    : "which is no number");
            if (fabs(row->cell[k]) > LARGEST) return fail_cell(names[k], cells[column[k]], row, "which is too large");
        }
        ++count;
    }
    if (count < 2) return fail("it has no two", "rows", NULL);
    own = malloc((size_t)count * sizeof *own);
    sorted = malloc((size_t)count * sizeof *sorted);
    return own == NULL || sorted == NULL ? fail("it needs", "more memory", NULL) : 0;
}

/* Numbers the recordings in the order in which they begin; returns how many there are. */
static long find_tracks(void) {
    long tracks = 0, i, t;
    for (i = 0; i < count; ++i) {
        t = i > 0 ? rows[i - 1].track : 0;
        if (i == 0 || strcmp(rows[i].recording, rows[i - 1].recording) != 0)
            for (t = 0; t < tracks && strcmp(rows[i].recording, own[t]->recording) != 0;) ++t;
        if (t == tracks) own[tracks++] = rows + i;
        rows[i].track = t;
    }
    return tracks;
}

/* Leaves out rows that have the time of the row before, and joins them with it where they supply each other. */
static int join_rows(long *n) {
    long kept = 0, left = 0, differing = 0, i, j, q;
    int k;
    for (i = 0; i < *n; i = j) {
        Row *head = own[i];
        double joined[COLUMNS];
        int supplied = 0, differ = 0;
        memcpy(joined, head->cell, sizeof joined);
        for (j = i + 1; j < *n && own[j]->time == head->time; ++j)
            for (k = 0; k < COLUMNS; ++k) {
                const double value = own[j]->cell[k];
                supplied |= value == value && joined[k] != joined[k];
                differ |= value == value && joined[k] == joined[k] && value != joined[k];
                if (joined[k] != joined[k]) joined[k] = value;
            }
        supplied = supplied && !differ;
        for (q = i + 1; q < j; ++q) {
            own[q]->copy = supplied ? JOINED : REPEATED;
            own[q - 1]->again = own[q];
            for (k = 0, differ = 0; k < COLUMNS; ++k)
                differ |= own[q]->cell[k] != head->cell[k] &&
                          (own[q]->cell[k] == own[q]->cell[k] || head->cell[k] == head->cell[k]);
            left += !supplied;
            differing += !supplied && differ;
        }
        if (supplied) memcpy(head->cell, joined, sizeof joined);
        own[kept++] = head;
    }
    if ((double)differing > MOST_TWICE * (double)(kept + left))
        return fail("many rows have the time of the row before and other values: write",
                    "times with their fractions of a second", NULL);
    *n = kept;
    return 0;
}

#ifndef WHOLE /* Rows at one rate need no median. */
static int ascending(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Median of the first n of the numbers to be sorted. */
static double median(long n) {
    qsort(sorted, (size_t)n, sizeof *sorted, ascending);
    return 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]);
}
#endif

/* Writes words as a cell of CSV. */
static void print_words(const char *words) {
    const int quoted = strpbrk(words, ",\"\r\n") != NULL;
    if (quoted) putchar('"');
    for (; *words != '\0'; ++words) {
        if (*words == '"') putchar('"');
        putchar(*words);
    }
    if (quoted) putchar('"');
}

/* Writes the status of a row, and of those with its time. */
static void print_row(const Row *row, int status, const Estimate *estimate) {
    int i;
    for (; row != NULL; row = row->again) {
        if (row->copy != 0) status = row->copy;
        if (recording_column >= 0) {
            print_words(row->recording);
            putchar(',');
        }
        if (row->words != NULL)
            print_words(row->words);
        else
            printf("%.17g", row->written);
        printf(",%s", statuses[status]);
        for (i = 0; i < COMPONENTS; ++i)
            if (status <= MISSED)
                printf(",%.*g", DIGITS, (double)MEAN(estimate, i));
            else
                putchar(',');
        for (i = 0; i < COMPONENTS; ++i)
            if (status <= MISSED)
                printf(",%.*g", DIGITS, sqrt((double)VARIANCE(estimate, i)));
            else
                putchar(',');
        putchar('\n');
    }
}

/* Counts the result of an update. */
static int note(const Row *row, int status) {
    if (status == REJECTED || status == REFUSED) {
        if (failures++ == 0) failed = row;
    }
    return status;
}

/* --- The tracks. */

static State state;

/* Follows a track of n rows, which are its own ones; below. */
static int follow(long n);

int main(int argc, char **argv) {
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : stdin;
    long tracks = 0, t, i, n;
    int wrong;
    if (file == NULL) return fail("cannot read", argv[1], NULL);
    wrong = read_text(file);
    if (file != stdin) fclose(file);
    if (wrong == 0) wrong = find_columns();
    if (wrong == 0) wrong = read_rows();
    if (wrong == 0) tracks = find_tracks();
    if (wrong == 0) printf("%s%s\n", recording_column < 0 ? "" : "recording,", header);
    for (t = 0; t < tracks && wrong == 0; ++t) {
        for (i = 0, n = 0; i < count; ++i)
            if (rows[i].track == t) own[n++] = rows + i;
        for (i = 1; i < n && wrong == 0; ++i)
            if (own[i]->time < own[i - 1]->time) wrong = fail(times[0], "decreases", own[i]);
        if (wrong == 0) wrong = join_rows(&n);
        if (wrong == 0 && n < 2) wrong = fail("a recording has no two", "rows", own[0]);
        if (wrong == 0) wrong = follow(n);
    }
    if (failures > 0) {
        fprintf(stderr, "%ld measurements were rejected or refused and left the state as it was, the first", failures);
        if (wrong == 0) wrong = fail("", "was", failed) - 1;
    }
    if (fflush(stdout) != 0 && wrong == 0) wrong = fail("cannot", "write", NULL);
    free(text);
    free(rows);
    free(own);
    free(sorted);
    return wrong;
}
