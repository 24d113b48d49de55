// A Kalman filter for ManeuveringTarget in C++ with Eigen: constant velocity, white acceleration of 2 m/s^2.
//
// c++ -std=c++17 -O2 -I/usr/include/eigen3 kalman.cpp -o kalman
// filtergym evaluate filtergym/ManeuveringTarget-v0 --policy exec:./kalman --policy imm
#include <Eigen/Dense>
#include <iostream>
#include <map>
#include <regex>
#include <string>
#include <vector>

using Eigen::Matrix2d, Eigen::Matrix4d, Eigen::Vector2d, Eigen::Vector4d;

struct Track {
    Vector4d x;  // x, y, vx, vy
    Matrix4d P;
};

// The number that follows a name in the hello; zero where there is none.
static long number(const std::string &hello, const std::string &name) {
    const auto place = hello.find("\"" + name + "\": ");
    return place == std::string::npos ? 0 : std::atol(hello.c_str() + place + name.size() + 4);
}

// Where the fields of a measurement begin among its numbers.
static std::map<std::string, long> fields(const std::string &hello) {
    const std::string part = hello.substr(hello.find("\"measurement\": ["));
    const std::regex field("\"name\": \"([^\"]*)\", \"shape\": \\[([^\\]]*)\\]"), digits("[0-9]+");
    std::map<std::string, long> found;
    long place = 0;
    for (std::sregex_iterator own(part.begin(), part.end(), field), end; own != end; ++own) {
        const std::string shape = (*own)[2];
        found[(*own)[1]] = place;
        long size = 1;
        for (std::sregex_iterator n(shape.begin(), shape.end(), digits), none; n != none; ++n) size *= std::stol(n->str());
        place += size;
    }
    return found;
}

static bool receive(std::vector<double> &numbers) {
    return static_cast<bool>(
        std::cin.read(reinterpret_cast<char *>(numbers.data()), static_cast<long>(numbers.size() * sizeof(double))));
}

static void update(Track &track, double T, bool seen, const Vector2d &z, const Vector2d &variance) {
    Matrix4d F = Matrix4d::Identity();
    F.topRightCorner<2, 2>() = T * Matrix2d::Identity();
    Eigen::Matrix<double, 4, 2> G;
    G << T * T / 2 * Matrix2d::Identity(), T * Matrix2d::Identity();
    track.x = F * track.x;
    track.P = F * track.P * F.transpose() + 4.0 * G * G.transpose();
    if (!seen) return;  // its position is NaN
    Matrix2d R = variance.asDiagonal();
    const Matrix2d S = track.P.topLeftCorner<2, 2>() + R;
    const Eigen::Matrix<double, 4, 2> K = track.P.leftCols<2>() * S.inverse();
    Matrix4d keep = Matrix4d::Identity();
    keep.leftCols<2>() -= K;
    track.x += K * (z - track.x.head<2>());
    track.P = keep * track.P * keep.transpose() + K * R * K.transpose();  // Joseph's form
}

int main() {
    std::ios::sync_with_stdio(false);
    std::string hello;
    std::getline(std::cin, hello);
    const long N = number(hello, "tracks"), M = number(hello, "measurement");
    if (number(hello, "filtergym") != 1 || number(hello, "initial") != 20 || number(hello, "answer") != 20) {
        std::cout << "{\"error\": \"this filter knows x, y, vx and vy\"}" << std::endl;
        return 2;
    }
    const auto field = fields(hello);
    std::cout << "{\"filtergym\": 1, \"format\": \"float64\"}" << std::endl;

    std::vector<double> initial(20 * N), measured(M * N), answer(20 * N);
    if (!receive(initial)) return 0;
    std::vector<Track> tracks(N);
    for (long i = 0; i < N; ++i) {
        tracks[i].x = Eigen::Map<Vector4d>(&initial[20 * i]);
        tracks[i].P = Eigen::Map<Matrix4d>(&initial[20 * i + 4]);
    }
    while (receive(measured)) {
        for (long i = 0; i < N; ++i) {
            const double *own = &measured[M * i];
            const Eigen::Map<const Vector2d> z(own + field.at("position")), variance(own + field.at("variance"));
            update(tracks[i], own[field.at("interval")], own[field.at("available")] > 0, z, variance);
            Eigen::Map<Vector4d> mean(&answer[20 * i]);
            Eigen::Map<Matrix4d> covariance(&answer[20 * i + 4]);
            mean = tracks[i].x;
            covariance = tracks[i].P;  // symmetric: rows or columns, all the same
        }
        std::cout.write(reinterpret_cast<char *>(answer.data()), 20 * N * static_cast<long>(sizeof(double)));
        std::cout.flush();
    }
}
